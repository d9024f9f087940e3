"""The paper's evaluation as one protocol: every method hears the same trials and answers in the same form."""
