"""Data sets in OVAD's layout and tables of feature windows."""
