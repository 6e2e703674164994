"""Whether this machine can do a run: its device, its memory, its leave to start processes."""

import torch

from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.system import resources, runtime
from rcdsac_trl.system.processes import check_may_start_processes, resolve_processes, resolve_processes_beside
from rcdsac_trl.training.make_learner import replay_size_bytes
from rcdsac_trl.training.warm_start import EndedRun, ended_run, inherited_steps
from rcdsac_trl.world.sim.simulation import SIMULATION_BYTES


def check_machine(settings: TrainingSettings) -> EndedRun | None:
    """Refuse what cannot be done here: there is no such device, too little memory, or no leave to start processes.

    Returns:
        The run that this one goes on from, whose replay was counted: whoever starts it takes what was checked.

    Raises:
        UserInputError: naming what there is.
    """
    runtime.resolve_device(settings.device)
    check_processes(settings)
    ended = ended_run(settings)
    check_memory(settings, inherited_steps(settings, ended))
    return ended


def check_processes(settings: TrainingSettings) -> None:
    """Refuse processes where none may be started, those of validation before hours of training too.

    Raises:
        UserInputError: naming what to set.
    """
    validation = settings.validation
    of_validation = resolve_processes_beside(validation.processes, validation.num_maps, settings.update_threads)
    collecting = resolve_processes(settings.collector.num_processes, settings.world.num_agents)
    if of_validation or collecting or settings.training_world.num_workers:
        check_may_start_processes()


def check_memory(settings: TrainingSettings, inherited_steps: int) -> None:
    """Refuse what surely does not fit; of a mini-batch its range observations alone are counted.

    Args:
        settings: of the run.
        inherited_steps: that its replay begins with.

    Raises:
        UserInputError: naming what is needed, what there is, and what to lower.
    """
    learner, others = settings.learner, "or end other programs"
    replay = replay_size_bytes(settings, settings.replay_steps(inherited_steps))
    resources.check_memory("the replay", replay, f"lower replay.capacity_steps, {others}")
    observations = learner.batch_size * (learner.sequence_length + 1)
    batch_bytes = observations * settings.sensor_mask.size * torch.float32.itemsize
    resources.check_memory("a mini-batch", batch_bytes, f"lower learner.batch_size, {others}")
    # Those of the training stay while a map is validated.
    simulations = settings.world.num_agents * (1 + len(settings.algo.default_conditions))
    needed_bytes = simulations * SIMULATION_BYTES
    resources.check_memory(f"{simulations} simulations", needed_bytes, f"lower world.num_agents, {others}")
