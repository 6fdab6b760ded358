"""Classification by template matching: which of several templates an image shows."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from jaxloc._jit import filter_jit
from jaxloc.alignment.correlation.peaks import find_peaks
from jaxloc.alignment.correlation.scores import Score, ZeroMeanCorrelation
from jaxloc.alignment.correlation.search import score_map
from jaxloc.images.warps import Translation
from jaxloc.solvers.estimate import guarded


class Classification(eqx.Module):
    """Result of a classification.

    Attributes:
        label: index of the best template.
        translation: its position, from template to image pixels.
        scores: the best correlation of each template.
        ok: True if one minus the best correlation is at most 0.8 times that of the next template.
    """

    label: Int[Array, ""]
    translation: Translation
    scores: Float[Array, " k"]
    ok: Bool[Array, ""]


@filter_jit
def classify(
    image: Num[Array, "h w"] | Any, templates: Num[Array, "k m n"] | Any, *, score: Score = ZeroMeanCorrelation()
) -> Classification:
    """Classifies an image by the template of the highest correlation, and locates it.

    Args:
        image: gray levels.
        templates: k gray images of one size.
        score: a correlation.

    Returns:
        Label, position, scores of all templates, and whether the best is distinct.

    Raises:
        ValueError: the score is a distance, there are no templates, or templates are larger than the image.

    References:
        Pallet type by template correlation [K-75].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> bank = jax.random.uniform(jax.random.key(0), (3, 8, 8))
        >>> found = classify(jnp.zeros((20, 20)).at[5:13, 3:11].set(bank[2]), bank)
        >>> int(found.label), found.translation.translation.round().tolist(), bool(found.ok)
        (2, [3.0, 5.0], True)
    """
    if score.best_is_least:
        raise ValueError(f"classify: {type(score).__name__} depends on contrast; use a correlation.")

    if not jnp.shape(templates)[0]:
        raise ValueError("classify: no templates; at least one is needed.")

    return guarded(jnp.array(True), lambda *given: _classify(*given, score), jnp.asarray(image), jnp.asarray(templates))


def _classify(image: Array, templates: Array, score: Score) -> Classification:
    def best(template: Array) -> tuple[Array, Array]:
        peaks = find_peaks(score_map(image, template, score=score), count=1)
        return peaks.scores[0], peaks.uv[0]

    scores, uv = jax.vmap(best)(templates)
    label = jnp.argmax(scores)
    others = jnp.max(jnp.where(jnp.arange(scores.shape[0]) == label, -1.0, scores))
    ok = (scores[label] > 0) & (1.0 - scores[label] <= 0.8 * (1.0 - others))
    return Classification(label, Translation(uv[label]), scores, ok)
