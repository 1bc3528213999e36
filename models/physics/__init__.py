"""The rotor of Eqs. (1)-(16), its coloured excitation, its correlation functions, and its exact discretisation."""
