"""The sky and the hardware, simulated; shares nothing with the reconstructor but :mod:`srtomo_core`."""
