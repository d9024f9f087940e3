"""Data sets in the layout of OVAD, and tables of feature windows."""
