"""The only place that opens artifacts and logs: one module per format, imported where it is needed."""
