"""The rotor as a signal source: scenarios, plant, sensors, and the programs that publish or record them."""
