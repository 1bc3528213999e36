"""The commands of ``rotorwatch`` by subject; each module has ``register(app)``."""
