"""Beliefs over explanations and entities, with their predict and update steps."""
