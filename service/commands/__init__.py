"""The commands of ``rotorwatch`` by subject; each module has them in ``commands``."""
