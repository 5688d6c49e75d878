# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The claims of the method's paper, each judged by a number that is computed here.

The verdicts are not stored: each follows from its number by a stated limit, so that a change of the
code that reversed a result would also change the table.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.model.arm import ElasticJointArm
from tsobs_ros.paper import examples
from tsobs_ros.paper.augmentation import (
    Augmentation,
    Condition,
    check_conditions,
    failing,
    innovation_drive,
    uncertainty_factor,
    unmatched_share,
)
from tsobs_ros.paper.runs import SETTLED, ArmComparison, ExampleRun
from tsobs_ros.paper.synthesis import check_stability

VERDICTS = HOLDS, HOLDS_ONLY_IF, DOES_NOT_HOLD = "holds", "holds only if", "does not hold"

ROUNDING = 1e-3
"""The largest ‖P M − C̄ᵀ‖ that can be due to only four printed decimals."""


class Claim(NamedTuple):
    """A claim and its verdict.

    Attributes:
        claim: One sentence.
        verdict: One of `VERDICTS`, decided by `number`.
        condition: The condition of "holds only if"; else a reason, or nothing.
        number: The computed number, as text with its unit.
    """

    claim: str
    verdict: str
    condition: str
    number: str

    @property
    def judgement(self) -> str:
        """Verdict and condition as one phrase."""
        if self.verdict == HOLDS_ONLY_IF:
            return f"{self.verdict} {self.condition}"
        return f"{self.verdict}: {self.condition}" if self.condition else self.verdict

    def __str__(self) -> str:
        detail = f"{self.condition}; {self.number}" if self.condition else self.number
        return f"{self.verdict.upper():<15}{self.claim}\n{'':<17}{detail}"


def judge(runs: Mapping[str, ExampleRun], comparison: ArmComparison) -> list[Claim]:
    """Return the table of claims, from the runs of Examples 1 and 2, by name, and of Example 3."""
    both = list(runs.values())
    return [*_of_printed(), *_of_designs(both), *_of_runs(both), *_of_arm(comparison)]


def check_printed_p() -> dict[str, Condition]:
    """Return (18) on {C̄x̄ = 0}, (19) and (38) with the printed P and M of Example 1."""
    example = examples.example_1()
    aug = Augmentation(example.system)
    epsilon = aug.epsilon(example.alpha, example.xi)
    return check_conditions(
        aug,
        examples.EXAMPLE_1_P,
        aug.alpha_1(example.alpha),
        M=examples.EXAMPLE_1_M,
        epsilon=epsilon,
        rounding=ROUNDING,
    )


def check_printed_gains() -> list[dict[str, Condition]]:
    """Return (37) with the printed P and H of Example 3, for each reading of them.

    A reading is a change of sign of P's coordinates, one of H's, and H taken as Hᵢ or E_L⁻¹Hᵢ.
    """
    aug, signs = Augmentation(examples.arm_system(ElasticJointArm())), examples.sign_changes(4)
    gains = [change[:, np.newaxis] * examples.EXAMPLE_3_H for change in signs]
    gains += [aug.E_L_inverse @ each for each in gains]
    matrices = [change[:, np.newaxis] * examples.EXAMPLE_3_P * change for change in signs]
    return [check_conditions(aug, P, np.zeros(2), H1=H1) for P in matrices for H1 in gains]


def _of_printed() -> list[Claim]:
    first, example = check_printed_p(), examples.example_1()
    rules = [first["(37) rule 1"], first["(37) rule 2"]]
    epsilon = Augmentation(example.system).epsilon(example.alpha, example.xi)
    return [
        Claim(
            "Example 1: the printed M is P⁻¹C̄ᵀ of the printed P (19).",
            HOLDS if first["(19)"].holds else DOES_NOT_HOLD,
            "to the printed digits, signs restored",
            f"‖P M − C̄ᵀ‖ = {first['(19)'].number:.1e}",
        ),
        Claim(
            "Example 1: the printed P satisfies (18) for both rules.",
            HOLDS if all(rule.holds for rule in rules) else DOES_NOT_HOLD,
            "rule 1 does, rule 2 does not, whatever Q₂ is",
            "largest eigenvalues on C̄x̄ = 0: " + ", ".join(f"{rule.number:+.3f}" for rule in rules),
        ),
        Claim(
            "Example 1: the printed P has ‖P⁻¹‖ ≥ ε (38).",
            HOLDS if first["(38)"].holds else DOES_NOT_HOLD,
            "as recomputed; by its own digits it just misses, but P may be scaled at will",
            f"‖P⁻¹‖ = {first['(38)'].number:.4f} (printed {examples.EXAMPLE_1_INVERSE_NORM}), "
            f"ε = {epsilon:.4f} (printed {examples.EXAMPLE_1_EPSILON})",
        ),
    ]


def _of_designs(runs: Sequence[ExampleRun]) -> list[Claim]:
    proof, reason = check_stability(examples.arm_system(ElasticJointArm()).A, np.zeros(2))
    designs = [run.design for run in runs]
    factors = [uncertainty_factor(design.P) for design in designs]
    drive = max(innovation_drive(design.augmentation) for design in designs)
    left = [
        unmatched_share(run.design.augmentation, run.design.P, run.example.delta_A) for run in runs
    ]
    return [
        Claim(
            "Examples 1 and 2: the LMIs (37) have a solution.",
            DOES_NOT_HOLD if any(failing(design.conditions) for design in designs) else HOLDS,
            "re-checked by eigenvalues",
            f"with ‖P⁻¹‖ = ε = {_list([design.epsilon for design in designs], '.4g')}",
        ),
        Claim(
            "Example 3: the LMIs (37) have a solution.",
            DOES_NOT_HOLD if proof.P is None else HOLDS,
            reason,
            f"dual proof: Z ⪰ 0, tr Z = 1, smallest eigenvalue of A Z + Z Aᵀ {proof.margin:.0e}",
        ),
        Claim(
            "(18) bounds the uncertainty: eᵀPΔA e ≤ α eᵀPe.",
            HOLDS if max(factors) <= 1.0 + 1e-9 else HOLDS_ONLY_IF,
            "α is multiplied by (√c + 1/√c)/2, c = cond(P)",
            f"factor {_list(factors, '.3f')} for our P of Examples 1, 2; "
            f"{uncertainty_factor(examples.EXAMPLE_1_P):.2f} for the printed one",
        ),
        Claim(
            "The output error y − ŷ corrects the state estimate.",
            HOLDS if drive > 1e-10 else DOES_NOT_HOLD,
            "the innovation is autonomous (Proposition 1)",
            f"relative gain from the plant to e_y: {_tiny(drive)}",
        ),
        Claim(
            "Some Ξᵢ ≠ 0 satisfies the matching assumption (15).",
            HOLDS if min(left) < 1.0 - 1e-9 else DOES_NOT_HOLD,
            "only ΔA = 0 does (Proposition 3)",
            f"the best Ξ leaves {min(left):.0%} of ΔA over",
        ),
    ]


def _of_runs(runs: Sequence[ExampleRun]) -> list[Claim]:
    exact = [float(run.settled_error("adaptive", 0).max()) for run in runs]
    uncertain = [run.settled_rms("adaptive", 1) for run in runs]
    fixed = [run.settled_rms("fixed", 1) for run in runs]
    change = max(float(np.abs(a / b - 1.0).max()) for a, b in zip(uncertain, fixed, strict=True))
    energies = [run.lyapunov("adaptive")[:, 0] for run in runs]
    rise = max(float(max(0.0, np.diff(V).max()) / V[0]) for V in energies)
    moved = max(run.difference("noise_fed") for run in runs)
    late = max(run.difference("model_only", SETTLED) for run in runs)
    silent = max(float(run.adaptation("consistent").max()) for run in runs)
    final = runs[0].adaptation("adaptive")[-1]
    return [
        Claim(
            "Without uncertainty (λ = 0), V decreases.",
            HOLDS if rise < 1e-6 else DOES_NOT_HOLD,
            "",
            f"largest rise in a step {_tiny(rise)} of V(0)",
        ),
        Claim(
            "Without uncertainty, state and disturbance errors vanish.",
            HOLDS_ONLY_IF if max(exact) < 1e-3 else DOES_NOT_HOLD,
            "every Aᵢ is stable, with one Lyapunov matrix (Proposition 2)",
            "largest error from 10 s on, Examples 1, 2: " + _list(exact, ".1e"),
        ),
        Claim(
            "With the printed ΔA (λ = 1), the errors vanish, too.",
            HOLDS if max(float(each.max()) for each in uncertain) < 1e-3 else DOES_NOT_HOLD,
            "they settle at a level that adaptation does not change",
            "RMS of x − x̂ from 10 s on: "
            + "; ".join(_list(each, ".4f", " / ") for each in uncertain)
            + f"; without adaptation within {100.0 * change:.0f} %",
        ),
        Claim(
            "The state estimate depends on the measurement.",
            HOLDS if moved >= 1e-10 else HOLDS_ONLY_IF,
            "its premise z = y₁ does: with z given, y may be replaced by noise",
            f"x̂ changes by {moved:.0e} (Examples 1 and 2, no adaptation); from 10 s on it is "
            f"the open-loop model to {late:.0e}",
        ),
        Claim(
            "The adaptive law estimates the uncertainty.",
            HOLDS if silent > 1e-10 else DOES_NOT_HOLD,
            "it integrates what is left of the observer's own start",
            f"started at ω̂(0) = y(0) − C x̂(0), ‖Ξ̂‖ stays at {silent:.0e}; at x̂̄(0) = 0 it moves to "
            f"{final[0]:.4f} at λ = 0 and to {final[1]:.4f} at λ = 1",
        ),
    ]


def _of_arm(comparison: ArmComparison) -> list[Claim]:
    x3, readings = comparison.motor_angle, check_printed_gains()
    high_gain, seeds = min(x3["PO"], x3["PIO"]), len(comparison.observers["PO"].rmse)
    least = min(max(one[f"(37) rule {rule}"].number for rule in (1, 2)) for one in readings)
    return [
        Claim(
            "Example 3: the printed P and H satisfy (37).",
            DOES_NOT_HOLD if all(map(failing, readings)) else HOLDS,
            f"in none of {len(readings)} readings: signs of P, of H; H as Hᵢ or E_L⁻¹Hᵢ",
            f"largest eigenvalue at least {least:+.1f}, must be negative",
        ),
        Claim(
            "Example 3: the method's x₃ is better than that of PO and PIO.",
            HOLDS if x3["paper"] < high_gain else DOES_NOT_HOLD,
            "",
            f"mean RMSE of x₃ over {seeds} runs: "
            + ", ".join(f"{name} {value:.3g}" for name, value in x3.items()),
        ),
        Claim(
            "Example 3: an observer with a disturbance model beats PO and PIO on x₃.",
            HOLDS if x3["ours"] < high_gain else DOES_NOT_HOLD,
            "the certified T–S observer, with a bias as its disturbance model",
            f"{x3['ours']:.4f} against {x3['PO']:.4f} and {x3['PIO']:.4f} at their best θ",
        ),
    ]


def _list(values: Sequence[float] | Array, style: str, separator: str = ", ") -> str:
    return separator.join(f"{value:{style}}" for value in values)


def _tiny(value: float) -> str:
    return f"{value:.0e}" if value else "0"
