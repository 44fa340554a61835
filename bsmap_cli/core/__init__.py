"""Mathematics that knows no stage: numpy and scipy only."""
