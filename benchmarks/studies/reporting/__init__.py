"""Framework of the studies: plan of windows, records, figures, charts and pages."""
