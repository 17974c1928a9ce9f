"""Ground motions, measured channels, file formats and response spectra."""
