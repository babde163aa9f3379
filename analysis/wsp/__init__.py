"""Water-sensitive paper: from a scan of cards to coverage, deposits and drop sizes."""
