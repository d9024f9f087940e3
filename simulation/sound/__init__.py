"""How sound gets from every source to every microphone."""
