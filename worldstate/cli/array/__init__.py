"""Commands about an array and its microphones."""
