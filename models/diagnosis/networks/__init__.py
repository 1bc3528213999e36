"""The equations (28)-(31) and their networks (relation and amortised), their training, and the trained bundle."""
