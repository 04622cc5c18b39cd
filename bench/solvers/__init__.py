"""Records QPs of real runs and replays them through every back end; see bench/README.md."""
