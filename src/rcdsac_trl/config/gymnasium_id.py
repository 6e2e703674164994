"""The environment's name in Gymnasium's registry; it imports nothing heavy, so that registering it stays instant."""

ENV_ID = "RCDSACNavigation-v0"


def register() -> None:
    """Register :data:`ENV_ID` with Gymnasium; harmless when done before."""
    import gymnasium  # imported late: who only drives a robot needs none

    if ENV_ID not in gymnasium.registry:
        gymnasium.register(ENV_ID, entry_point="rcdsac_trl.config.named_world:gymnasium_env")
