"""Beliefs of explanations and entities, and their predict and update steps."""
