"""Commands of the laboratory: the evaluation of the paper and studies of our own."""
