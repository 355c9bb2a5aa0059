"""Calibration of inertial accelerometers on precision centrifuges."""
