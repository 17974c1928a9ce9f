"""Posterior from few simulations: modes, an emulator of the response per mode, and draws near the posterior."""
