"""Networks, their loss and what updates them."""

import safetensors.torch
import torch
from tensordict.nn import TensorDictModuleBase, TensorDictParams, TensorDictSequential
from torch import nn
from torch.optim.swa_utils import AveragedModel
from torchrl.objectives import LossModule

from rcdsac_trl.agent.actor import build_actor, build_critic
from rcdsac_trl.agent.loss.distributional_sac import DistributionalSACLoss
from rcdsac_trl.agent.loss.target_updates import FusedAverage
from rcdsac_trl.agent.transforms import Relabel
from rcdsac_trl.config.learner_settings import LearnerSettings
from rcdsac_trl.config.training_settings import TrainingSettings
from rcdsac_trl.robot.observation import vector_observations
from rcdsac_trl.rollout.policies import AgentNoise, LeanPolicy, OnDevice
from rcdsac_trl.seeding import torch_seed, torch_stream
from rcdsac_trl.world.task.spaces import ACTION_SIZE


def packed(actor: nn.Module) -> bytes:
    """Pack the weights of an actor, so that later changes do not reach them and another process can have them."""
    return safetensors.torch.save(actor.state_dict())


def make_loss(settings: TrainingSettings, device: str) -> LossModule:
    """Make actor, critics and their loss, with weights from the stream ``"weights"``."""
    algo, learner, network = settings.algo, settings.learner, settings.network
    # Layers draw their first weights from torch's global generator: lend it our stream, and give it back.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(torch_seed(settings.seed, "weights"))
        actor = _build_actor(settings)
        critics = [
            build_critic(ACTION_SIZE, _vectors(settings), algo.critic, algo.network_measure, network)
            for _ in range(learner.num_critics)
        ]
    loss = DistributionalSACLoss(
        actor.to(device),
        [critic.to(device) for critic in critics],
        learner,
        measure=algo.distortion.measure,
        generator=torch_stream(settings.seed, "loss"),  # on the CPU: so a run goes on, and is evaluated, anywhere
        threads=settings.update_threads,
    ).to(device)
    loss.make_value_estimator(gamma=learner.gamma)
    return loss


def packed_loss(loss: LossModule) -> bytes:
    """Pack the networks of a loss, so that another process can have them."""
    # Copies: modules share their parameters with the loss, and safetensors refuses what is shared.
    return safetensors.torch.save({key: value.clone() for key, value in loss.state_dict().items()})


def unpacked_loss(settings: TrainingSettings, packed: bytes) -> LossModule:
    """Make a loss on the CPU with networks that were packed."""
    loss = make_loss(settings, "cpu")
    loss.load_state_dict(safetensors.torch.load(packed))
    return loss


def _vectors(settings: TrainingSettings) -> dict[str, int]:
    """Name the vector observations of the networks, and their sizes."""
    weighted = settings.algo.told_weights is not None
    return vector_observations(settings.sensor.memory_s) | ({"collision_weight": 1} if weighted else {})


def _build_actor(settings: TrainingSettings) -> TensorDictSequential:
    return build_actor(ACTION_SIZE, _vectors(settings), settings.algo.network_measure, settings.network)


def make_actor(settings: TrainingSettings) -> TensorDictSequential:
    """Make an actor on the CPU whose weights are yet to be loaded."""
    with torch.random.fork_rng(devices=[]):  # it would draw first weights from torch's global generator
        return _build_actor(settings)


def make_average(loss: LossModule, learner: LearnerSettings) -> AveragedModel:
    """Make the running average of the actor's weights; it is what is validated, evaluated and deployed."""
    return FusedAverage(loss.actor_network, learner.actor_average_decay)


def make_policy(actor: TensorDictSequential, noise: AgentNoise, device: str) -> TensorDictModuleBase:
    """Make the acting policy of an actor; it shares the actor's weights."""
    policy = LeanPolicy(actor, noise)
    return policy if device == "cpu" else OnDevice(policy, device)


def make_optimizer(loss: LossModule, learner: LearnerSettings) -> torch.optim.Optimizer:
    """Make one Adam with a learning rate for each of the three losses."""
    groups = [
        {"params": parameters(loss.actor_network_params), "lr": learner.actor_lr},
        {"params": parameters(loss.critic_network_params), "lr": learner.critic_lr},
        {"params": [loss.log_alpha], "lr": learner.alpha_lr},
    ]
    return torch.optim.Adam(groups, fused=True)


def parameters(params: TensorDictParams) -> list[torch.nn.Parameter]:
    """List the parameters of one network of a loss."""
    return [p for p in params.values(True, True) if isinstance(p, torch.nn.Parameter)]


def make_relabel(settings: TrainingSettings) -> Relabel | None:
    """Make what sets the beta of a batch; None where losses read no beta."""
    algo = settings.algo
    if algo.critic == "scalar":
        return None
    fixed = None
    if algo.conditioning != "per_episode":
        fixed = algo.beta if algo.beta is not None else algo.distortion.measure.neutral_beta
    return Relabel(
        algo.distortion.measure,
        mode="fixed" if fixed is not None else algo.relabel,
        per=settings.learner.resample_per,
        beta=fixed,
        generator=torch_stream(settings.seed, "relabel"),
    )
