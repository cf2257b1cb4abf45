"""The run folder: its receipts, its record, and finished runs."""
