"""Rotors of another model class than the monitor's: finite elements, several discs and bearings, cubic stiffness."""
