"""From samples to spectra: hops, short-time Fourier transform, bands, phase transform."""
