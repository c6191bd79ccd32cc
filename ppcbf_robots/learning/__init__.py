"""Training of barriers: the only package, besides proofs, that imports torch."""
