"""How networks learn: objectives, trainers, Jacobians, and how rows are split in time. No model stands here."""
