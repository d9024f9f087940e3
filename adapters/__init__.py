"""Adapters: everything that touches a file, a camera, a data set, a bus or a clock."""
