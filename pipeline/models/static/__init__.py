"""Models without a past: RBF and MLP networks, pairs of them, applicability domains. No trainer stands here."""
