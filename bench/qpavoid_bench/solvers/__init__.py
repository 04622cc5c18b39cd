"""QPs of real runs, solved by every back end that is installed, and judged by what can be computed of an answer."""
