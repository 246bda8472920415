"""Numbers become tables, charts and pages."""
