"""From three seconds of window evidence to what comes into view, when, and on which side."""
