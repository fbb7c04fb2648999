"""The benchmark: composes scenes with ground truth, runs methods on them and measures their pictures."""
