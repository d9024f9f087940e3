"""S_t = {entities, relations, context, cues} as immutable values."""
