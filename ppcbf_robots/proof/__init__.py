"""Bounds that hold on whole boxes of states, and proofs by branch and bound made of them."""
