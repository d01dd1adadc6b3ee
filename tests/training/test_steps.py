"""Oracles: the same steps written out, counts, a closed form."""

import copy

import numpy as np
import pytest
import torch

from training import steps
from training.steps import EMA, Stepper, Task, falling_rate, minibatches


def test_the_rate_falls_at_the_end():
    rates = [falling_rate(step, 1000, 1.0, warm=100) for step in range(1000)]
    assert rates[0] == 0.01 and rates[99] == 1 and rates[600] == 1
    assert np.all(np.diff(rates[100:]) <= 0)
    assert 0 < rates[-1] < 0.03


def test_every_row_drawn_is_in_one_minibatch_and_tasks_come_in_the_order_asked_for():
    calls = []

    def drawer(name, count):
        def draw(rows, generator):
            assert rows == steps.DRAWN * count
            calls.append(name)
            first = 1000 * len(calls)
            return {"x": torch.arange(first, first + rows), "y": torch.zeros(rows, 2)}

        return Task(0.5, count, draw, lambda inputs: (inputs["y"].sum(), {}))

    tasks = [drawer("a", 3), drawer("b", 2)]
    order = [0, 1] * steps.DRAWN + [0]
    drawn = list(minibatches(tasks, order, torch.Generator()))
    assert [index for index, _ in drawn] == order
    assert calls == ["a", "b", "a"]  # one more than fits in the first is drawn anew
    for index, inputs in drawn:
        assert len(inputs["x"]) == tasks[index].count == len(inputs["y"])
    first = torch.cat([x["x"] for index, x in drawn[:-1] if index == 0])
    assert sorted(first.tolist()) == list(range(1000, 1000 + 3 * steps.DRAWN))


def test_a_step_is_adamws_with_a_clipped_gradient_and_an_average_beside_it():
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Linear(4, 1))
    other = copy.deepcopy(net)
    average = [p.detach().clone() for p in other.parameters()]

    def loss(x):
        value = (100 * net(x["x"])).square().mean()
        return value, {"loss": value.detach()}

    stepper = Stepper(net, 1e-2, [Task(1.0, 2, None, loss)], torch.device("cpu"))
    matrices = [p for p in other.parameters() if p.ndim == 2]
    biases = [p for p in other.parameters() if p.ndim == 1]
    optimizer = torch.optim.AdamW(
        [{"params": matrices, "weight_decay": 0.01}, {"params": biases, "weight_decay": 0.0}], betas=(0.9, 0.99)
    )  # fmt: skip
    for step in range(3):
        x = torch.randn(2, 3, generator=torch.Generator().manual_seed(step))
        rate = 1e-2 / (step + 1)
        parts = stepper.step(0, {"x": x}, rate)
        value = (100 * other(x)).square().mean()
        assert float(parts["loss"]) == pytest.approx(float(value.detach()), rel=1e-6)
        gradients = torch.autograd.grad(value, list(other.parameters()))
        norm = sum(float(g.square().sum()) for g in gradients) ** 0.5
        assert norm > 1
        for p, g in zip(other.parameters(), gradients, strict=True):
            p.grad = g / norm
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.step()
        average = [
            EMA * a + (1 - EMA) * p.detach()
            for a, p in zip(average, other.parameters(), strict=True)
        ]
    for a, b in zip(net.parameters(), other.parameters(), strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-6)
    for a, b in zip(stepper.average.module.parameters(), average, strict=True):
        assert torch.allclose(a, b, rtol=0, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_recorded_graph_takes_the_steps_that_kernels_one_by_one_take():
    device = torch.device("cuda")
    torch.manual_seed(0)
    first = torch.nn.Linear(3, 4).to(device)
    other = copy.deepcopy(first)

    def task(net):
        return Task(1.0, 2, None, lambda x: (net(x["x"]).square().mean(), {}))

    graph = Stepper(first, 1e-2, [task(first)], device)
    eager = Stepper(other, 1e-2, [task(other)], device)
    for step in range(4):
        x = torch.randn(2, 3, generator=torch.Generator().manual_seed(step)).to(device)
        graph.step(0, {"x": x}, 1e-2 / (step + 1))
        for group in eager.optimizer.param_groups:
            group["lr"].fill_(1e-2 / (step + 1))
        eager.now(0, {"x": x})
    assert torch.allclose(first.weight, other.weight, atol=1e-6)
    assert torch.allclose(graph.average.module.weight, eager.average.module.weight, atol=1e-6)
