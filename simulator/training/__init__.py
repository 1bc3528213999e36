"""``rotortrain train``: windows drawn at random, and the command that trains, calibrates and writes a bundle."""
