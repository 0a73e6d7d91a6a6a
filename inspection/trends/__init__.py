"""What a tool's history says: wear lines, forecasts, control charts. Pure numbers, no database."""
