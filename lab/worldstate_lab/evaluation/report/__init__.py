"""The report of an evaluation: its contents as values, its figures, and the files written from them."""
