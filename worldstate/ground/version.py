"""The version number, for packaging, the command line and written files."""

__version__ = "0.4.0"
