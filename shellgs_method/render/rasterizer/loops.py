"""Kernels over a chunk of splats of many tiles: C++ on a CPU with a compiler, else torch, with the same results."""

from __future__ import annotations

import ctypes
import functools
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from shellgs_method.machine import cpp
from shellgs_method.machine.elementwise import in_loops
from shellgs_method.machine.symbols import PRELUDE, Symbol, statements
from shellgs_method.render.rasterizer.binning import TILE
from shellgs_method.render.rasterizer.kernels import (
    TRANSMITTANCE_MIN,
    Kernels,
    attenuate,
    composite_splat,
    contributions,
    splat_gradients,
    step_back,
)
from shellgs_method.render.rasterizer.plans import CHUNK, LANES


class Chunk(NamedTuple):
    """Some splats of many tiles; see :mod:`~.kernels` for the letters."""

    before: Float[Tensor, "G P V"]
    """Transmittance before them, 0 once the pixel has stopped."""
    table: Float[Tensor, "N K"]
    """Parameters of all splats."""
    splats: Int32[Tensor, "G L V"]
    """Rows of the table."""
    centres: Float[Tensor, "G 2 V"]
    """Centres of the tiles."""

    def parameters(self) -> list[list[Float[Tensor, "G 1 V"]]]:
        """Parameters of each splat, with u and v relative to the tiles' centres."""
        u, v, *rest = self.table[self.splats].unbind(-1)  # [G L V] each
        params = torch.stack([u - self.centres[:, :1], v - self.centres[:, 1:], *rest])
        return [list(splat.unbind(0)) for splat in params[:, :, :, None].unbind(2)]


@dataclass(frozen=True)
class Loops:
    """Kernels of a primitive for a number of features.

    Attributes:
        kernels: arithmetic of the primitive.
        n_features: number of features, alpha included.
        n_first: number of features whose gradients w.r.t. the screen position are separate, if any are.
    """

    kernels: Kernels
    n_features: int
    n_first: int | None = None

    @property
    def n_totals(self) -> int:
        """Number of composited totals."""
        return self.n_features + self.kernels.n_maps

    @property
    def n_groups(self) -> int:
        """Number of groups of features with separate gradients."""
        return 1 if self.n_first is None else 2

    @property
    def n_columns(self) -> int:
        """Number of a splat's parameters, and of those with separate gradients."""
        return self.kernels.n_shape + self.n_features + (0 if self.n_first is None else self.kernels.n_probed)

    def groups(self, gradients: Sequence) -> list[Sequence]:
        """Gradients of the totals that are sums of weight times value, in the groups with separate gradients."""
        weighted = gradients[: self.n_totals - self.kernels.n_unweighted]
        return [weighted] if self.n_first is None else [weighted[: self.n_first], weighted[self.n_first :]]

    def forward(
        self, chunk: Chunk, totals: list[Float[Tensor, "G P V"]], stop: float = TRANSMITTANCE_MIN
    ) -> tuple[Float[Tensor, "G P V"], Float[Tensor, "G V"]]:
        """Add a chunk to the totals; return the transmittance behind it, and its maximum over each tile's pixels."""
        before = chunk.before
        if compiled := _compiled(self, chunk.table):
            behind, brightest = torch.empty_like(before), before.new_empty(len(before), LANES)
            arguments = _at(*chunk, behind, brightest, *totals)
            compiled.forward(_threads(before), len(before), ctypes.c_float(stop), *arguments)
            return behind, brightest
        (x, y), transmittance, sums = _pixels(chunk.table), before, totals
        for splat in chunk.parameters():
            transmittance, sums = composite_splat(self.kernels, splat, x, y, transmittance, stop, sums)
        for total, new in zip(totals, sums, strict=True):
            total.copy_(new)
        return transmittance, transmittance.amax(1)

    def backward(
        self,
        chunk: Chunk,
        behinds: list[Float[Tensor, "G P V"]],
        gradients: list[Float[Tensor, "G P V"]],
        grad_params: Float[Tensor, "G L V K+probed"],
    ) -> None:
        """Go through a chunk back to front, given the gradients of the totals.

        Fills ``grad_params``, the gradients of the splats' parameters summed over a tile's pixels, followed by those of
        the first ``n_probed`` due to the first group of features alone, if groups are separate. Updates ``behinds``,
        one for each group (see :func:`~.kernels.step_back`), to before the chunk.
        """
        before = chunk.before
        if compiled := _compiled(self, chunk.table):
            arguments = _at(*chunk, grad_params, *behinds, *gradients)
            compiled.backward(_threads(before), len(before), *arguments)
            return
        kernels, params, (x, y) = self.kernels, chunk.parameters(), _pixels(chunk.table)
        befores, alphas, grad_z = [], [], []
        evaluated = [kernels.evaluate(splat[: kernels.n_shape], x, y) for splat in params]
        for at in evaluated:
            befores.append(before)
            alpha, before = attenuate(at.z, before, TRANSMITTANCE_MIN)
            alphas.append(alpha)
        groups, new = self.groups(gradients), behinds
        for splat, at, transmittance, alpha in zip(
            *(e[::-1] for e in (params, evaluated, befores, alphas)), strict=True
        ):
            values = [*splat[kernels.n_shape :], *at.maps]
            new, of_z = step_back(values, at.z, transmittance, alpha, new, groups)
            grad_z.insert(0, of_z)
        for behind, each in zip(behinds, new, strict=True):
            behind.copy_(each)
        # All splats at once, [L G P V].
        shape = [torch.stack(each) for each in zip(*params, strict=True)][: kernels.n_shape]
        at = kernels.evaluate(shape, x, y)
        stacked = torch.stack(befores), torch.stack(alphas), [torch.stack(each) for each in zip(*grad_z, strict=True)]
        sums = [each.sum(2) for each in contributions(kernels, at, x, y, *stacked, gradients)]
        columns = splat_gradients(kernels, [each[:, :, 0] for each in shape], sums, self.n_features)
        grad_params.copy_(torch.stack(columns).permute(2, 1, 3, 0))


def _pixels(table: Tensor) -> tuple[Float[Tensor, "1 P 1"], Float[Tensor, "1 P 1"]]:
    """Pixel coordinates relative to the tile's centre."""
    side = torch.arange(TILE, dtype=table.dtype, device=table.device) + 0.5 - TILE / 2
    return side.repeat(TILE)[None, :, None], side.repeat_interleave(TILE)[None, :, None]


def _threads(before: Tensor) -> int:
    return min(torch.get_num_threads(), len(before))


def _at(*tensors: Tensor) -> list[ctypes.c_void_p]:
    """Addresses of the tensors' first values."""
    assert all(tensor.is_contiguous() for tensor in tensors)
    return [ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors]


def _compiled(loops: Loops, table: Tensor) -> ctypes.CDLL | None:
    """The loops in C++, where these run."""
    return _library(loops) if table.is_cpu and in_loops(table) else None


@functools.cache
def _library(loops: Loops) -> ctypes.CDLL | None:
    _keep_freed_memory()
    return cpp.load_library(_source(loops))


def _keep_freed_memory() -> None:
    """Make glibc keep some freed memory, which costs 1 ms/MB to get from the system again.

    It keeps up to twice the largest block freed so far, among blocks of up to 32 MB.
    """
    torch.empty((32 << 20) - (1 << 16), dtype=torch.uint8)


_SOURCE = """
constexpr int L = {chunk}, P = {pixels}, TILE = {tile}, K = {params}, COLUMNS = {columns}, SUMS = {sums};

static void look_up(vec q[L][K], const float *table, const int32_t *splats, const float *centres) {{
    for (int l = 0; l < L; ++l) {{
        for (int v = 0; v < V; ++v)
            for (int k = 0; k < K; ++k) q[l][k][v] = table[splats[l * V + v] * K + k];
        q[l][0] -= load(centres);
        q[l][1] -= load(centres + V);
    }}
}}

extern "C" void forward(int threads, int groups, float stop_at, const float *before, const float *table,
                        const int32_t *splats, const float *centres, float *behind, float *brightest, {totals}) {{
    const vec stop = all(stop_at);
#pragma omp parallel for num_threads(threads)
    for (int g = 0; g < groups; ++g) {{
        vec params[L][K], most = all(0);
        look_up(params, table, splats + (int64_t)g * L * V, centres + g * 2 * V);
        for (int p = 0; p < P; ++p) {{
            const vec x = all(p % TILE + 0.5f - TILE / 2), y = all(p / TILE + 0.5f - TILE / 2);
            const int64_t at = ((int64_t)g * P + p) * V;
            vec T = load(before + at);
{load_totals}
            for (int l = 0; l < L; ++l) {{
                const vec *q = params[l];
{composite}
            }}
{store_totals}
            store(behind + at, T);
            most = T > most ? T : most;
        }}
        store(brightest + g * V, most);
    }}
}}

extern "C" void backward(int threads, int groups, const float *before, const float *table, const int32_t *splats,
                         const float *centres, float *grad_params, {behinds}, {gradients}) {{
    const vec stop = all({stop}f);
#pragma omp parallel for num_threads(threads)
    for (int g = 0; g < groups; ++g) {{
        vec params[L][K], sums[L][SUMS] = {{}};
        look_up(params, table, splats + (int64_t)g * L * V, centres + g * 2 * V);
        for (int p = 0; p < P; ++p) {{
            const vec x = all(p % TILE + 0.5f - TILE / 2), y = all(p / TILE + 0.5f - TILE / 2);
            const int64_t at = ((int64_t)g * P + p) * V;
            vec T = load(before + at), transmittance[L], alphas[L];
            for (int l = 0; l < L; ++l) {{
                const vec *q = params[l];
                vec alpha;
                transmittance[l] = T;
{attenuate}
                alphas[l] = alpha;
            }}
{load_gradients}
            for (int l = L - 1; l >= 0; --l) {{
                const vec *q = params[l];
                vec *sum = sums[l];
                T = transmittance[l];
                const vec alpha = alphas[l];
{step_back}
            }}
{store_behinds}
        }}
        for (int l = 0; l < L; ++l) {{
            const vec *q = params[l], *sum = sums[l];
            vec columns[COLUMNS];
{splat_gradients}
            float *rows = grad_params + ((int64_t)g * L + l) * V * COLUMNS;
            for (int v = 0; v < V; ++v)
                for (int k = 0; k < COLUMNS; ++k) rows[v * COLUMNS + k] = columns[k][v];
        }}
    }}
}}
"""


def _source(loops: Loops) -> str:
    """C++ of the loops, with the arithmetic of the kernels written out for one splat at 16 tiles' pixels."""
    kernels, n_totals = loops.kernels, loops.n_totals
    n_params = kernels.n_shape + loops.n_features
    splat, x, y, before, alpha = _names("q[{}]", n_params), *map(Symbol, ("x", "y", "T", "alpha"))
    shape, stop = splat[: kernels.n_shape], Symbol("stop")
    totals, gradients = _names("s{}", n_totals), _names("g{}", n_totals)
    groups = loops.groups(gradients)
    behinds = _names("b{}", len(groups))

    after, new = composite_splat(kernels, splat, x, y, before, stop, totals)  # pyright: ignore[reportArgumentType]
    composite = {"T = {}": after} | {f"s{i} = {{}}": each for i, each in enumerate(new)}
    at = kernels.evaluate(shape, x, y)
    new_alpha, after = attenuate(at.z, before, stop)  # pyright: ignore[reportArgumentType]
    back, grad_z = step_back([*splat[kernels.n_shape :], *at.maps], at.z, before, alpha, behinds, groups)
    added = contributions(kernels, at, x, y, before, alpha, grad_z, gradients)
    columns = splat_gradients(kernels, shape, _names("sum[{}]", len(added)), loops.n_features)
    backwards = {f"b{i} = {{}}": each for i, each in enumerate(back)}
    backwards |= {f"sum[{i}] += {{}}": each for i, each in enumerate(added)}
    return (
        '#pragma GCC optimize("O3")\n'
        + PRELUDE.format(lanes=LANES)
        + _SOURCE.format(
            chunk=CHUNK,
            pixels=TILE * TILE,
            tile=TILE,
            params=n_params,
            columns=len(columns),
            sums=len(added),
            stop=TRANSMITTANCE_MIN,
            totals=_listed("float *total{}", n_totals),
            behinds=_listed("float *behind{}", len(groups)),
            gradients=_listed("const float *gradient{}", n_totals),
            load_totals=_each("vec s{0} = load(total{0} + at);", n_totals),
            composite=_indented(statements(composite)),
            store_totals=_each("store(total{0} + at, s{0});", n_totals),
            attenuate=_indented(statements({"alpha = {}": new_alpha, "T = {}": after})),
            load_gradients="\n".join(
                [
                    _each("vec b{0} = load(behind{0} + at);", len(groups)),
                    _each("const vec g{0} = load(gradient{0} + at);", n_totals),
                ]
            ),
            step_back=_indented(statements(backwards)),
            store_behinds=_each("store(behind{0} + at, b{0});", len(groups)),
            splat_gradients=_indented(statements({f"columns[{i}] = {{}}": each for i, each in enumerate(columns)})),
        )
    )


def _names(template: str, count: int) -> list[Symbol]:
    return [Symbol(template.format(i)) for i in range(count)]


def _listed(template: str, count: int) -> str:
    return ", ".join(template.format(i) for i in range(count))


def _each(template: str, count: int) -> str:
    return _indented("\n".join(template.format(i) for i in range(count)))


def _indented(code: str) -> str:
    return textwrap.indent(code, 12 * " ")
