"""Responses of a linear system of first order as sums over its complex modes.

Each mode k obeys q_k' = lam_k q_k + f_k(t), with a forcing that is a straight line between its samples. Its step is
then exact with three constants (Nigam & Jennings 1969, in complex form) ::

    q(t + dt) = decay q(t) + before f(t) + after f(t + dt)

References
----------
N. C. Nigam, P. C. Jennings, Calculation of response spectra from strong-motion earthquake records, Bulletin of the
Seismological Society of America 59(2), 1969, 909-922.
"""

from .jit import kernel

__all__ = ["superpose_modes"]


@kernel
def superpose_modes(decay, before, after, participation, shapes, excitation, out):
    """Add to `out` the real parts of the modes' responses, which start from zero.

    Parameters
    ----------
    decay, before, after : ndarray (n_modes,) complex
        Constants of the step, see above.
    participation : ndarray (n_modes, n_inputs) complex
        Forcing of a mode under unit inputs.
    shapes : ndarray (n_modes, n_rows) complex
        Share of a mode in each row of the response.
    excitation : ndarray (n_inputs, n_steps)
    out : ndarray (n_rows, n_steps)
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
