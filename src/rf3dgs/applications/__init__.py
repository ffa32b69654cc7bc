"""What one does with paths and spectra: beams, localisation, coverage, sensing, calibration."""
