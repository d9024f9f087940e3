"""Signature and cueing on labelled feature windows, with intervals and paired differences."""
