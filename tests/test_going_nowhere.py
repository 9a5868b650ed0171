"""A training that learns no more than the same answer everywhere is doubted, once; one that learns is not."""

import numpy as np
import pytest

from mereo.training.going_nowhere import SETTLED, ConstantAnswer, Judge

CONSTANT = ConstantAnswer(ce=1.2, l1=0.1, miou=0.05)


def test_the_constant_answer_is_the_best_that_there_is() -> None:
    """No constant probabilities have a lower cross-entropy, and no constant distance a lower mean error."""
    rng = np.random.default_rng(0)
    labels = rng.choice(4, size=(10, 300), p=[0.5, 0.3, 0.15, 0.05]).astype(np.uint8)
    distances = rng.normal(size=labels.shape)
    found = ConstantAnswer.of(labels, distances, True)
    shares = np.bincount(labels.ravel()) / labels.size
    others = rng.dirichlet(50 * shares, 1000)
    assert found.ce == pytest.approx(-(shares * np.log(shares)).sum())
    assert (-(np.log(others) * shares).sum(axis=1) >= found.ce).all()
    assert all(found.l1 <= np.abs(distances - other).mean() for other in np.linspace(-1, 1, 101))
    occupied = (labels > 0).sum()
    assert found.miou == pytest.approx((labels == 1).mean() / 3), "the most frequent segment everywhere"
    assert ConstantAnswer.of(labels, distances, False).miou == pytest.approx(occupied / labels.size)


def rows(steps: int, score: float, **losses: list[float]) -> list[dict[str, float]]:
    """Record of so many steps whose losses go evenly from the first value to the second, the last step with scores."""
    course = [
        {name: float(np.interp(n, [0, steps - 1], value)) for name, value in losses.items()} for n in range(steps)
    ]
    return [*course[:-1], course[-1] | {"val_iou": score, "val_miou": score}]


@pytest.mark.parametrize(
    ("record", "doubted"),
    [
        (rows(200, 0.0, loss=[5.0, 5.0], ce=[1.8, 1.8]), True),  # a learning rate of nothing
        (rows(200, 0.0, loss=[5.0, 2.0], ce=[1.8, 1.2]), True),  # distances are learnt, labels are not
        (rows(200, 0.0, loss=[5.0, 2.0], ce=[1.8, 0.9]), False),
        (rows(200, 0.3, loss=[5.0, 5.0], ce=[1.2, 1.2]), False),  # scored well: the averaged network is better
        (rows(200, 0.8, loss=[0.5, 0.5], ce=[0.1, 0.1]), False),  # begun from weights of the same object
        (rows(199, 0.0, loss=[5.0, 5.0], ce=[1.8, 1.8]), False),  # not a tenth yet
        (rows(200, 0.0, loss=[5.0, 4.9], l1=[0.3, 0.1]), True),  # without labels, distances count
        (rows(200, 0.0, loss=[5.0, 2.0], l1=[0.3, 0.05]), False),
    ],
)
def test_what_is_doubted_after_a_tenth(record: list[dict[str, float]], doubted: bool) -> None:
    judge = Judge(CONSTANT, 2000)
    assert bool(judge.doubt(record)) == doubted
    longer = record + rows(50, 0.0, **{name: [9.0, 9.0] for name in record[0] if name != "step"})
    if judge.decided:
        assert not judge.doubt(longer), "it is said once, and not of one that has learnt"


def test_of_a_short_run_whose_loss_falls_it_is_asked_later() -> None:
    judge = Judge(CONSTANT, 200)
    assert not judge.doubt(rows(20, 0.0, loss=[5.0, 3.0], ce=[1.8, 1.2]))
    text = judge.doubt(rows(SETTLED, 0.0, loss=[5.0, 2.0], ce=[1.8, 1.2]))
    assert text.startswith(
        f"\nwarning: after {SETTLED} of 200 steps the network tells labels no better than the same answer"
    )
    assert "--init" in text and "--learning-rate" in text
    assert Judge(CONSTANT, 200).doubt(rows(20, 0.0, loss=[5.0, 5.0], ce=[1.8, 1.8])), "of one that does not, at once"
