"""The equations (28)-(31) and their networks: as printed, as relations, amortised; training and bundle."""
