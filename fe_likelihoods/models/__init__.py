"""Structural models: built-in structures, and wrappers for models of your own.

* Built-in structures: `rc_column`, `isolated_bridge`, `linear_oscillator`, `linear_structure`. Modules
  named after a structure, such as `rc_column_parts` and `isolated_bridge_channels`, belong to it.
* Wrappers: `function`, `executable`, `opensees`, `umbridge`, all based on `user_model`.
* Shared by several models: `base`, `threaded`, `validation`, `circular_section`.
"""
