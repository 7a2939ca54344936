"""Local linear models and the linearized plant. No blending of controllers stands here."""
