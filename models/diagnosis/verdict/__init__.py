"""From readings to a verdict: thresholds, which set changed, when, and what would be noticed."""
