"""Training of image models on pairs; stands above the stages, whose networks it trains. Knows no commands."""
