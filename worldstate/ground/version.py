"""The version, in one place: packaging, the command line and what is written to files read it here."""

__version__ = "0.3.0"
