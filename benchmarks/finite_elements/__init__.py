"""Rotors of another model class than the monitor's own: finite elements, more discs and bearings, cubic stiffness."""
