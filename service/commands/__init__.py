"""The commands of ``rotorwatch`` by subject; each module defines its commands in ``commands``."""
