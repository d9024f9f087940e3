"""Commands of the laboratory: the evaluation of the paper, and further studies."""
