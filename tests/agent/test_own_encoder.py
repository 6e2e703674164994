"""An encoder that no compiled twin knows: trained, acting, evaluated and exported by its own layers."""

import io
from pathlib import Path

import pytest
import torch
from encoders import DeepEncoder, FrameStack
from tensordict import TensorDict
from torch import nn

from rcdsac_trl.agent.actor import build_actor, build_critic
from rcdsac_trl.agent.kernels import dispatch
from rcdsac_trl.agent.networks import ActorHead, Encoder, NetworkSettings
from rcdsac_trl.agent.risk import PowerLaw
from rcdsac_trl.deploy.export.modules import ActorStep
from rcdsac_trl.errors import UserInputError
from rcdsac_trl.release.run_weights import weights_of_run
from rcdsac_trl.robot.observation import VECTOR_OBSERVATIONS
from rcdsac_trl.rollout.make_agent import make_loss
from rcdsac_trl.rollout.policies import AgentNoise, LeanPolicy
from rcdsac_trl.rollout.quantile_predictor import QuantilePredictor
from tiny import evaluate, tiny_settings, tiny_trainer

OWN = [DeepEncoder, FrameStack]
SIZES = {"range": 180, **VECTOR_OBSERVATIONS}


def settings_of(encoder: type) -> NetworkSettings:
    return NetworkSettings(
        conv=4, range=8, vector=4, memory=8, head=8, cosines=4, encoder=f"encoders.{encoder.__name__}"
    )


def observations(*lead: int) -> dict[str, torch.Tensor]:
    return {key: torch.rand(*lead, size) for key, size in SIZES.items()}


@pytest.mark.parametrize("encoder", OWN)
def test_steps_are_the_sequence_and_no_twin_takes_its_place(encoder: type) -> None:
    actor = build_actor(measure=PowerLaw(), network=settings_of(encoder))
    module = actor[0].module
    assert type(module) is encoder
    seen = observations(40, 6)
    whole = dispatch.forward(module, *seen.values())
    assert torch.equal(whole, module(*seen.values()))
    state = torch.ones(40, 8)
    for t in range(6):
        first = torch.full((40, 1), t == 0)
        memory, state = dispatch.step(module, *(value[:, t] for value in seen.values()), first, state)
        torch.testing.assert_close(memory, whole[:, t])
    assert not dispatch.has_compiled_actor(module, actor[1].module)


def test_twins_take_the_place_of_the_very_layers_they_know() -> None:
    def knows(encoder: nn.Module, head: nn.Module) -> bool:
        return dispatch.has_compiled_actor(encoder, head)

    network = NetworkSettings(conv=4, range=8, vector=4, memory=8, head=8, cosines=4)
    head = ActorHead(2, network, PowerLaw())
    assert knows(Encoder(VECTOR_OBSERVATIONS, network), head)
    for change in (
        lambda module: setattr(module, "gru", nn.GRU(16, 8, num_layers=2, batch_first=True)),
        lambda module: setattr(module, "gru", nn.GRU(16, 8, bias=False, batch_first=True)),
        lambda module: setattr(module.range, "conv_1", nn.Conv1d(1, 4, 5, stride=2, dilation=1, bias=False)),
        lambda module: module.vectors.__setitem__(0, nn.Sequential(nn.Linear(6, 4))),
    ):
        encoder = Encoder(VECTOR_OBSERVATIONS, network)
        change(encoder)
        assert not knows(encoder, head)
    head.hidden = nn.Sequential(head.hidden)  # type: ignore[assignment]
    assert not knows(Encoder(VECTOR_OBSERVATIONS, network), head)
    swapped = Encoder(VECTOR_OBSERVATIONS, network)
    swapped.gru = nn.GRU(16, 8, num_layers=2, batch_first=True)
    seen = observations(8, 5)
    assert torch.equal(dispatch.forward(swapped, *seen.values()), swapped(*seen.values()))


@pytest.mark.parametrize("encoder", OWN)
def test_it_acts_and_its_critics_predict(encoder: type) -> None:
    torch.manual_seed(0)  # first weights are drawn from torch's global generator
    network = settings_of(encoder)
    actor = build_actor(measure=PowerLaw(), network=network)
    noise = AgentNoise(range(2))
    noise.begin(0, "test")
    policy = LeanPolicy(actor, noise)
    predictor = QuantilePredictor([build_critic(measure=PowerLaw(), network=network) for _ in range(2)], [1])
    now = TensorDict(observations(2), batch_size=[2]).set("risk", -torch.rand(2, 1))
    now["is_init"], now["recurrent_state"] = torch.ones(2, 1, dtype=torch.bool), torch.ones(2, 8)
    for _ in range(3):
        now = policy(now)
        assert now["action"].abs().max() < 1.0
        assert predictor.step(now).shape == (1, 16)
        assert not torch.equal(now["next", "recurrent_state"], now["recurrent_state"])
        now["recurrent_state"], now["is_init"] = now["next", "recurrent_state"], torch.zeros(2, 1, dtype=torch.bool)


# The exporter on how torch's GRU holds its weights.
@pytest.mark.filterwarnings("ignore:The tensor attributes")
@pytest.mark.parametrize("encoder", OWN)
def test_a_run_trains_is_evaluated_and_its_actor_exported(encoder: type, tmp_path: Path) -> None:
    named = f"network.encoder=encoders.{encoder.__name__}"
    trainer = tiny_trainer(tmp_path / "run", "rcdsac_pow", "logger=default", named)
    trainer.run()
    before = make_loss(tiny_settings("rcdsac_pow", named), "cpu").actor_network.state_dict()
    actor = trainer.learner.loss.actor_network
    moved = [key for key, value in actor.state_dict().items() if not torch.equal(value, before[key])]
    assert any(key.startswith("module.0") for key in moved)
    table = evaluate(f"run={tmp_path / 'run'}", "beta=[-1.0]", f"out={tmp_path / 'evaluation'}") / "episodes.csv"
    assert len(table.read_text().splitlines()) > 1
    with pytest.raises(UserInputError, match="weights folders hold our own encoder alone"):
        weights_of_run(tmp_path / "run", "last")
    module = ActorStep(actor[0].module, actor[1].module).eval()
    given = *(value for value in observations(1).values()), torch.full((1, 1), -1.0), torch.rand(1, 128)
    file = io.BytesIO()
    torch.export.save(torch.export.export(module, given), file)
    file.seek(0)
    for found, expected in zip(torch.export.load(file).module()(*given), module(*given), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("encoders.Nothing", "cannot be imported"),
        ("nowhere.Encoder", "cannot be imported"),
        ("Encoder", "cannot be imported"),
        ("torch.nn.GRU", "is no HistoryEncoder"),
    ],
)
def test_what_is_no_encoder_is_refused(path: str, told: str) -> None:
    with pytest.raises(UserInputError, match=f"network.encoder={path} {told}"):
        NetworkSettings(encoder=path)
