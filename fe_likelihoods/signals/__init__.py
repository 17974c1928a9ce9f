"""Ground motions, measured channels, file formats, data sets and response spectra."""
