"""Evaluation of many recordings by several processes or computers, with results as Parquet tables."""
