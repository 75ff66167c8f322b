"""How robots learn: the policy ensemble, critics, data, pre-training."""
