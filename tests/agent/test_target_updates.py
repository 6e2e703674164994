"""The averaged actor's step, against torch's own."""

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from rcdsac_trl.agent.loss.target_updates import FusedAverage


def moved(model: nn.Module) -> None:
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn(parameter.shape))


def test_the_average_is_torchs_bit_by_bit_and_outlives_a_load() -> None:
    torch.manual_seed(0)
    model = nn.Sequential(nn.Linear(3, 5), nn.Linear(5, 2))
    ours = FusedAverage(model, decay=0.9)
    theirs = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(0.9))
    kept = {}
    for step in range(6):
        moved(model)
        if step == 4:  # as a checkpoint brings both back
            model.load_state_dict({key: value + 1.0 for key, value in model.state_dict().items()})
            ours.load_state_dict(kept)
            theirs.load_state_dict(kept)
        for average in (ours, theirs):
            average.update_parameters(model)
        assert ours.state_dict().keys() == theirs.state_dict().keys()
        for key, value in theirs.state_dict().items():
            assert torch.equal(ours.state_dict()[key], value), (step, key)
        if step == 2:
            kept = {key: value.clone() for key, value in ours.state_dict().items()}
    first = next(iter(ours.module.parameters()))
    assert not torch.equal(first, next(iter(model.parameters())))


def test_a_decay_of_zero_is_the_model_itself() -> None:
    model = nn.Linear(3, 5)
    average = FusedAverage(model, decay=0.0)
    for _ in range(3):
        moved(model)
        changes = average.module.weight._version
        average.update_parameters(model)
        assert torch.equal(average.module.weight, model.weight)
        assert average.module.weight._version > changes  # what acts with the average reads this count
