"""Writes optim.npz, the reference values of tests/testsuite/optim_peers.rs: ten steps of PyTorch's optimizers and what belongs to
them, in f64.

    pip install numpy torch                  # torch 2.15, numpy 2.4 wrote the committed file
    python make_optim.py

There are two parameters: a matrix [2, 3] and a vector [4]. All cases begin at the same values and get the same
gradients, exact in f32, and learning rates:

    start.a, start.b      the parameters before the first step
    grads.a, grads.b      the gradients, [step, ..]
    rates                 the learning rates, [step]
    CASE.a, CASE.b        the parameters after each step, [step, ..]
    table, shares         a table [5, 2] and for each step the gradients of its rows INDEX, [step, 3, 2]
    sparse_adam           the table after each step
    clip.norms            the norm of all gradients before each step
    clip.a, clip.b        the gradients, limited to the norm 1
    schedule.NAME         the learning rate before each of STEPS steps
"""

from pathlib import Path

import numpy as np
import torch
from torch.optim import SGD, Adam, AdamW, SparseAdam, lr_scheduler
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

STEPS = 10
INDEX = [3, 1, 3]
arrays = {}


def noise(shape, scale, seed):
    """Normal numbers, exact in f32."""
    values = scale * np.random.default_rng(seed).normal(size=shape)
    return values.astype(np.float32).astype(np.float64)


arrays["start.a"], arrays["start.b"] = noise((2, 3), 1.0, 1), noise(4, 1.0, 2)
arrays["grads.a"], arrays["grads.b"] = noise((STEPS, 2, 3), 1.0, 3), noise((STEPS, 4), 0.1, 4)
arrays["rates"] = (0.05 * (1 + np.arange(STEPS) % 3 / 4)).astype(np.float32).astype(np.float64)
arrays["table"], arrays["shares"] = noise((5, 2), 1.0, 5), noise((STEPS, 3, 2), 1.0, 6)


class Model(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.a = torch.nn.Parameter(torch.tensor(arrays["start.a"]))
        self.b = torch.nn.Parameter(torch.tensor(arrays["start.b"]))

    def take_gradients(self, step):
        self.a.grad, self.b.grad = (torch.tensor(arrays[f"grads.{name}"][step]) for name in "ab")

    def record(self, case):
        for name, value in (("a", self.a), ("b", self.b)):
            arrays.setdefault(f"{case}.{name}", []).append(value.detach().numpy().copy())


def run(case, make, after=lambda model: model):
    """Ten steps; what is recorded after each is `after` of the model."""
    model = Model()
    optimizer = make(model.parameters())
    for step in range(STEPS):
        model.take_gradients(step)
        optimizer.param_groups[0]["lr"] = arrays["rates"][step]
        optimizer.step()
        after(model).record(case)


run("sgd", lambda p: SGD(p, lr=0.1))
run("sgd_decay", lambda p: SGD(p, lr=0.1, weight_decay=0.25))
run("momentum", lambda p: SGD(p, lr=0.1, momentum=0.75))
run("momentum_decay", lambda p: SGD(p, lr=0.1, momentum=0.75, weight_decay=0.25))
run("nesterov", lambda p: SGD(p, lr=0.1, momentum=0.75, nesterov=True))
run("nesterov_decay", lambda p: SGD(p, lr=0.1, momentum=0.75, nesterov=True, weight_decay=0.25))
run("adam", lambda p: Adam(p, lr=0.1))
run("adam_table", lambda p: Adam(p, lr=0.1, betas=(0.9, 0.99), eps=1e-15))
run("adam_odd", lambda p: Adam(p, lr=0.1, betas=(0.5, 0.25), eps=0.125))
run("adamw", lambda p: AdamW(p, lr=0.1, weight_decay=0.25))
run("adamw_odd", lambda p: AdamW(p, lr=0.1, betas=(0.5, 0.75), eps=1e-3, weight_decay=2.0))

averages = {}


def averaged(model):
    average = averages.setdefault("ema", AveragedModel(Model(), multi_avg_fn=get_ema_multi_avg_fn(0.75)))
    if not average.n_averaged:
        average.update_parameters(Model())  # the first one is taken as it is
    average.update_parameters(model)
    return average.module


run("ema", lambda p: SGD(p, lr=0.1, momentum=0.75), averaged)

table = torch.nn.Parameter(torch.tensor(arrays["table"]))
optimizer = SparseAdam([table], lr=0.1, eps=1e-20)  # PyTorch does not correct its epsilon
for step in range(STEPS):
    shares = torch.tensor(arrays["shares"][step])
    table.grad = torch.sparse_coo_tensor([INDEX], shares, table.shape, check_invariants=True)
    optimizer.param_groups[0]["lr"] = arrays["rates"][step]
    optimizer.step()
    arrays.setdefault("sparse_adam", []).append(table.detach().numpy().copy())

for step in range(STEPS):
    model = Model()
    model.take_gradients(step)
    norm = torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    arrays.setdefault("clip.norms", []).append(norm.item())
    for name, value in (("a", model.a), ("b", model.b)):
        arrays.setdefault(f"clip.{name}", []).append(value.grad.numpy().copy())

for name, make in {
    "cosine": lambda o: lr_scheduler.CosineAnnealingLR(o, T_max=STEPS, eta_min=0.01),
    "exponential": lambda o: lr_scheduler.ExponentialLR(o, gamma=0.1 ** (1 / STEPS)),
    "step": lambda o: lr_scheduler.StepLR(o, step_size=3, gamma=0.5),
    "linear": lambda o: lr_scheduler.LinearLR(o, start_factor=1.0, end_factor=0.25, total_iters=STEPS),
    "warmup": lambda o: lr_scheduler.LambdaLR(o, lambda step: min(1.0, step / 4)),
}.items():
    optimizer = SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.5)
    scheduler = make(optimizer)
    for step in range(STEPS):
        arrays.setdefault(f"schedule.{name}", []).append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()

path = Path(__file__).with_name("optim.npz")
np.savez_compressed(path, **{name: np.array(value, dtype=np.float64) for name, value in arrays.items()})
print(len(arrays), "arrays,", path.stat().st_size, "bytes")
