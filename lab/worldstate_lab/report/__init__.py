"""Tables and figures of every study, and their output as text, JSON, CSV, pages and results."""
