"""What the law will lead to, and other ways to drive its QP where that does not arrive."""
