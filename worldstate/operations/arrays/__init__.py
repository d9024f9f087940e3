"""What an array allows, how near the estimators come to it, and what they cost."""
