# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs of the method's Examples 1 and 2: the plant once, then every observer on its record."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.estimation.high_gain import integrate
from tsobs_ros.paper.examples import PaperExample
from tsobs_ros.paper.observer import AugmentedObserver, AugmentedState
from tsobs_ros.paper.records import AdaptiveDesign

Advance = Callable[[], None]
"""Called once a simulated piece of work, to show progress."""

PERIOD = 4e-3
"""Step of plant and observer [s]. Between samples y is taken as linear, which is off by
(T²/8)|ÿ| < 2e-5 for the fastest disturbance of the examples; the tests halve it and see."""

DURATION = 20.0
SETTLED = 10.0

UNCERTAINTIES = (0.0, 1.0)
"""λ of the two plants that are simulated together: without and with the printed ΔA."""

WORK = 4
"""Pieces of work of `run_example`: the plants, then the observers in three batches."""

_NOISE_SEED = 20110022


@dataclass(frozen=True)
class PlantRecord:
    """What the plants did.

    Attributes:
        times: [s], shape (samples,).
        states: x, shape (samples, 2, n); the second axis is λ ∈ {0, 1}.
        disturbance: ω, shape (samples, p).
        outputs: y, shape (samples, 2, p).
        premises: z = y₁, shape (samples, 2, 1).
        weights: h, shape (samples, 2, r).
    """

    times: Array
    states: Array
    disturbance: Array
    outputs: Array
    premises: Array
    weights: Array


@dataclass(frozen=True)
class EstimateRecord:
    """What one observer made of it.

    Attributes:
        states: x̂, shape (samples, 2, n).
        disturbance: ω̂, shape (samples, 2, p).
        innovation: e_y, shape (samples, 2, p).
        adaptation: Largest ‖Ξ̂ᵢ‖ over the rules, shape (samples, 2).
        adaptation_energy: Σ tr(Ξ̂ᵢᵀΓᵢ⁻¹Ξ̂ᵢ), shape (samples, 2); zero without adaptation.
    """

    states: Array
    disturbance: Array
    innovation: Array
    adaptation: Array
    adaptation_energy: Array


@dataclass(frozen=True)
class ExampleRun:
    """An example with its plants and the observers that were run on them.

    Attributes:
        example: The example.
        design: The gains in use, from (37), re-checked.
        plant: What the plants did.
        estimates: By variant, see `run_example`.
    """

    example: PaperExample
    design: AdaptiveDesign
    plant: PlantRecord
    estimates: dict[str, EstimateRecord]

    def state_error(self, variant: str) -> Array:
        """Return x − x̂, shape (samples, 2, n)."""
        return np.asarray(self.plant.states - self.estimates[variant].states)

    def disturbance_error(self, variant: str) -> Array:
        """Return ω − ω̂, shape (samples, 2, p)."""
        truth = self.plant.disturbance[:, np.newaxis]
        return np.asarray(truth - self.estimates[variant].disturbance)

    def lyapunov(self, variant: str) -> Array:
        """Return V = ēᵀPē + Σ tr(Ξ̂ᵢᵀΓᵢ⁻¹Ξ̂ᵢ), shape (samples, 2).

        It is the method's V where Ξᵢ = 0, which is at λ = 0.
        """
        aug, record = self.design.augmentation, self.estimates[variant]
        # ē = x̄ − x̂̄ is T e_x on {C̄x̄ = 0} and e_y across it.
        error = self.state_error(variant) @ aug.blind_basis.T
        error[..., aug.state_count :] += record.innovation
        energy = np.sum(error @ self.design.P * error, axis=-1)
        return np.asarray(energy + record.adaptation_energy)

    def settled_error(self, variant: str, uncertainty: int) -> Array:
        """Return the largest |x − x̂|, |ω − ω̂| from 10 s on, shape (n + p,).

        Args:
            variant: The observer.
            uncertainty: 0 for λ = 0, 1 for λ = 1.
        """
        joined = np.concatenate([self.state_error(variant), self.disturbance_error(variant)], -1)
        return np.asarray(np.abs(joined[self.plant.times >= SETTLED, uncertainty]).max(axis=0))

    def settled_rms(self, variant: str, uncertainty: int) -> Array:
        """Return the RMS of x − x̂ from 10 s on, shape (n,)."""
        error = self.state_error(variant)[self.plant.times >= SETTLED, uncertainty]
        return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def run_example(
    example: PaperExample,
    design: AdaptiveDesign,
    *,
    period: float = PERIOD,
    duration: float = DURATION,
    advance: Advance = lambda: None,
) -> ExampleRun:
    """Simulate the example with λ = 0 and 1 and run five variants of the observer.

    adaptive: the method's observer with its adaptation, Ξ̂ᵢ projected on ‖Ξ̂ᵢ‖ ≤ ξᵢ.
    fixed: the same without adaptation.
    noise_fed: as fixed, but y is replaced by white noise of standard deviation 1; only the
        premise z is still the plant's.
    model_only: the model integrated from x̂(0) = 0 with no measurement at all but z.
    consistent: as adaptive, but started at ω̂₀(0) = y(0), so that e_y(0) = 0.

    Args:
        example: Example 1 or 2.
        design: Its gains.
        period: Step [s].
        duration: [s].
        advance: Called after each of the `WORK` pieces of work.
    """
    plant = _simulate(example, period, duration)
    advance()
    fixed = design.observer(adapt=False)
    aug = design.augmentation
    model_only = AugmentedObserver(aug, np.zeros_like(fixed.H1), np.zeros_like(fixed.M))
    noise = np.random.default_rng(_NOISE_SEED).standard_normal(plant.outputs.shape)
    zero = np.zeros((len(UNCERTAINTIES), aug.size))
    fitting = zero.copy()
    fitting[:, aug.state_count :] = plant.outputs[0]
    estimates: dict[str, EstimateRecord] = {}
    for observer, variants in (
        (
            design.observer(),
            {"adaptive": (plant.outputs, zero), "consistent": (plant.outputs, fitting)},
        ),
        (fixed, {"fixed": (plant.outputs, zero), "noise_fed": (noise, zero)}),
        (model_only, {"model_only": (plant.outputs, zero)}),
    ):
        outputs = np.stack([fed for fed, _ in variants.values()], axis=1)
        start = np.stack([begun for _, begun in variants.values()])
        records = _observe(example, observer, plant, outputs, start)
        estimates.update(zip(variants, records, strict=True))
        advance()
    return ExampleRun(example, design, plant, estimates)


def _simulate(example: PaperExample, period: float, duration: float) -> PlantRecord:
    samples = round(duration / period) + 1
    times = np.asarray(np.arange(samples) * period, dtype=np.float64)
    uncertainty = np.array(UNCERTAINTIES)[:, np.newaxis]
    states = np.empty((samples, len(UNCERTAINTIES), example.system.state_count))
    x = np.repeat(example.initial_state[np.newaxis], len(UNCERTAINTIES), axis=0)
    clock: Array = np.zeros((len(UNCERTAINTIES), 1))

    def derivative(joined: Array) -> Array:
        # Time is carried as one more state, so that the signals are exact within a step.
        state, time = joined[..., :-1], joined[..., -1]
        z = state[..., :1] + example.disturbance(time)[..., :1]
        rate = example.derivative(state, example.torque(time), z, uncertainty)
        return np.concatenate([rate, np.ones_like(joined[..., -1:])], axis=-1)

    for index, time in enumerate(times):
        states[index] = x
        joined: Array = np.hstack([x, clock + time])
        x = integrate(derivative, joined, period, period)[..., :-1]
    disturbance = np.asarray(example.disturbance(times))
    premises: Array = states[..., :1] + disturbance[:, np.newaxis, :1]
    outputs = example.system.output(states, premises) + disturbance[:, np.newaxis]
    weights = example.system.rule_base.weights(premises)
    return PlantRecord(times, states, disturbance, outputs, premises, weights)


def _observe(
    example: PaperExample,
    observer: AugmentedObserver,
    plant: PlantRecord,
    outputs: Array,
    start: Array,
) -> list[EstimateRecord]:
    """Run an observer over several records at once; its premises are the plant's for all.

    Args:
        example: Whose input is used.
        observer: The observer.
        plant: Whose premises are used.
        outputs: What is fed to the observer, shape (samples, records, 2, p).
        start: x̂̄(0), shape (records, 2, n + p).

    Returns:
        One record of estimates for each record of outputs.
    """
    torques = example.torque(plant.times)
    fed: Array = outputs.copy()
    # ξ(0) = x̂̄(0) − E_L⁻¹L y(0): with a first sample of noise the observer would start elsewhere.
    fed[0] = plant.outputs[0]
    premises: Array = np.broadcast_to(plant.premises[:, np.newaxis], (*fed.shape[:-1], 1))
    state = observer.initial(fed[0], start, z=premises[0])
    states = [state]
    for index, duration in enumerate(np.diff(plant.times), 1):
        u, u_next = torques[index - 1], torques[index]
        state = observer.advance(state, u, u_next, fed[index], duration, premises[index])
        states.append(state)
    whole = AugmentedState(*(np.stack(each) for each in zip(*states, strict=True)))
    estimate, innovation = observer.estimate(whole), observer.innovation(whole)
    norms = np.linalg.norm(whole.Xi, 2, axis=(-2, -1)).max(axis=-1)
    energy = np.zeros_like(norms)
    if observer.Gamma is not None:
        scaled = np.linalg.solve(observer.Gamma, whole.Xi)
        energy = np.sum(scaled * whole.Xi, axis=(-3, -2, -1))
    return [
        EstimateRecord(*(each[:, one] for each in (*estimate, innovation, norms, energy)))
        for one in range(fed.shape[1])
    ]
