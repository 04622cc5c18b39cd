"""Times one control step of qpavoid and of its peers on identical work; see bench/README.md."""
