"""Reports: records, text and pictures."""
