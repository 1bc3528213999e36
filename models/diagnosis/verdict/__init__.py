"""From readings to a verdict: thresholds, which parameters changed, when, and which changes are detectable."""
