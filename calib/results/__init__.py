"""Results read again from where commands wrote them: one protocol for all kinds, and what the viewer draws of them."""
