"""Tables and figures of every study, and how they become text, JSON, CSV, pages and results."""
