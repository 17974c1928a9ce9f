"""Structural models: built-in structures, and wrappers for models of your own.

`rc_column`, `isolated_bridge`, `linear_oscillator` and `linear_structure` are structures, with the modules named after
them. `function`, `executable`, `opensees` and `umbridge` are wrappers, based on `user_model`. `base` and `validation`
are shared.
"""
