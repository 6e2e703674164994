"""Risk-conditioned distributional soft actor-critic for risk-sensitive navigation, on TorchRL."""
