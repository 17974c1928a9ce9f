"""Response of a linear first-order system as a sum over its complex modes.

Each mode k satisfies q_k' = lam_k q_k + f_k(t), where the forcing f_k is linear between its samples. A step is then
exact with three constants (Nigam & Jennings 1969, in complex form)::

    q(t + dt) = decay q(t) + before f(t) + after f(t + dt)

``docs/theory/time_integration.rst`` derives the constants.
"""

from .jit import kernel

__all__ = ["superpose_modes"]


@kernel
def superpose_modes(decay, before, after, participation, shapes, excitation, out):
    """Add the real parts of all modal responses, which start from zero, to `out`.

    Parameters
    ----------
    decay, before, after : ndarray (n_modes,) complex
        Constants of the step.
    participation : ndarray (n_modes, n_inputs) complex
        Forcing of a mode under unit inputs.
    shapes : ndarray (n_modes, n_rows) complex
        Contribution of a unit modal coordinate to each row of the response.
    excitation : ndarray (n_inputs, n_steps)
        Samples of the inputs.
    out : ndarray (n_rows, n_steps)
        Changed in place.
    """
    n_inputs, n_steps = excitation.shape
    for k in range(decay.shape[0]):
        state = 0.0 + 0.0j
        forcing = 0.0 + 0.0j
        for j in range(n_inputs):
            forcing += participation[k, j] * excitation[j, 0]
        for t in range(1, n_steps):
            state = decay[k] * state + before[k] * forcing
            forcing = 0.0 + 0.0j
            for j in range(n_inputs):
                forcing += participation[k, j] * excitation[j, t]
            state += after[k] * forcing
            for i in range(shapes.shape[1]):
                out[i, t] += shapes[k, i].real * state.real - shapes[k, i].imag * state.imag
