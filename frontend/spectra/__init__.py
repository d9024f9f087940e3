"""Spectra of samples: hops, short-time Fourier transform, bands, phase transform."""
