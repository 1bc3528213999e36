"""The likelihood: theoretical against estimated cross-spectra, its search, its errors, and the bound."""
