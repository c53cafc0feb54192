"""Published figures, measured again with srtomo's own plant, loop and reconstructors."""
