"""The compiled recursion of `best_sequences`: grow the tree of sequences, prune it, combine.

A vector's lanes (hybridtrack.vectors) are sequences of modes here, not runs: one run comes after
the other. What the tree grows by is the bank's own prediction and update.
"""

from typing import NamedTuple

import numpy as np

from hybridtrack.compiled import lane_kernel, row_kernel
from hybridtrack.elementary import exp, log, maximum
from hybridtrack.estimators._layout import (
    Array,
    BankState,
    Indices,
    SparseMaps,
    group_of,
    in_vectors,
)
from hybridtrack.estimators._rows import apply
from hybridtrack.estimators._update import update
from hybridtrack.vectors import WIDTH, repeat, select, store, vectors


class Chain(NamedTuple):
    """The chain of supermodes; without a bound they are the modes."""

    mode: Indices  # (n_supermodes,) each one's mode
    initial_probabilities: Array  # (n_supermodes,)
    transition_matrix: Array  # (n_times or 1, n_supermodes, n_supermodes)
    log_origins: SparseMaps  # logarithms of its transpose: a row for where a supermode comes from
    log_members: SparseMaps  # logarithms of 1: a row for the supermodes of a mode
    final_probability: Array  # (n_supermodes,); (0,) where nothing can be said of it


class Sequences(NamedTuple):
    """The sequences of each run; overwritten by `advance`. Those beyond `kept` mean nothing."""

    mean: Array  # (runs, n_groups, n_x, WIDTH)
    covariance: Array  # (runs, n_groups, n_packed, WIDTH)
    log_weight: Array  # (runs, n_groups, n_supermodes, WIDTH) the run's largest is about 0
    kept: Indices  # (runs,)


class Tree(NamedTuple):
    """Scratch memory: every sequence of a run with every mode after it."""

    filters: BankState  # (n_groups, n_modes, ...)
    log_weight: Array  # (n_groups, n_supermodes, WIDTH)
    log_total: Array  # (n_groups, n_modes, WIDTH) all supermodes of the mode together
    log_likelihood: Array  # (n_modes, WIDTH)
    found: Array  # (n_groups n_modes WIDTH,) the totals of those that are possible
    weight: Array  # (n_groups, WIDTH) of the kept
    lanes: Array  # (WIDTH,)


@row_kernel
def add_up(out, maps, time, log_weight):
    """out <- log(A w), given the logarithms of the sparse A and of w."""
    for t in range(maps.first.shape[1] - 1):
        first, last = maps.first[0, t], maps.first[0, t + 1]
        largest = repeat(-np.inf)
        for s in range(first, last):
            largest = maximum(largest, log_weight[maps.column[0, s]] + maps.weight[time, 0, s])
        scale = select(largest == -np.inf, 0.0, largest)
        total = repeat(0.0)
        for s in range(first, last):
            total += exp(log_weight[maps.column[0, s]] + maps.weight[time, 0, s] - scale)
        out[t] = scale + log(total)


@row_kernel
def grow(b, k, sequences, tree, work, model, chain, seen):
    """Follow every sequence of run b by every mode: predict, update, weigh."""
    time = k if model.state_map.weight.shape[0] > 1 else 0
    noise_time = k if model.process_noise_covariance.shape[0] > 1 else 0
    chain_time = k if chain.log_origins.weight.shape[0] > 1 else 0
    log_weight, log_total = vectors(tree.log_weight), vectors(tree.log_total)
    log_likelihood = vectors(tree.log_likelihood)
    for g in range(-(-sequences.kept[b] // WIDTH)):
        mean, covariance = vectors(sequences.mean)[b, g], vectors(sequences.covariance)[b, g]
        filters = group_of(tree.filters, g)
        for j in range(tree.log_likelihood.shape[0]):
            input_effect = model.input_effect[time, j]
            apply(filters.mean[j], model.state_map, time, j, mean, input_effect)
            Q = model.process_noise_covariance[noise_time, j]
            apply(filters.covariance[j], model.covariance_map, time, j, covariance, Q)
            update(j, filters, work, model, seen, False)
            log_likelihood[j] = work.exponent[j] + log(work.density[j])
        add_up(log_weight[g], chain.log_origins, chain_time, vectors(sequences.log_weight)[b, g])
        for s in range(chain.mode.size):
            log_weight[g, s] = log_weight[g, s] + log_likelihood[chain.mode[s]]
        add_up(log_total[g], chain.log_members, 0, log_weight[g])


@row_kernel
def nth_largest(values, size, n):
    """The n-th largest of the first `size` values, which are put in another order (Hoare 1961)."""
    low, high, place = 0, size - 1, n - 1
    while low < high:
        pivot = values[place]
        i, j = low, high
        while i <= j:
            while values[i] > pivot:
                i += 1
            while pivot > values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < place:
            low = i
        if place < i:
            high = j
    return values[place]


@row_kernel
def prune(b, sequences, tree, chain, most):
    """Keep the most probable sequences, in the tree's order; of equals the first ones.

    What is impossible is left out; so is what overflowed (NaN), which has no place in an order.
    """
    n_groups, n_modes, found = -(-sequences.kept[b] // WIDTH), tree.log_total.shape[1], 0
    for g in range(n_groups):
        for j in range(n_modes):
            for lane in range(WIDTH):
                if tree.log_total[g, j, lane] > -np.inf:
                    tree.found[found] = tree.log_total[g, j, lane]
                    found += 1
    count = min(found, most)
    least = nth_largest(tree.found, found, count) if found else 0.0
    largest, equals = least, count
    for i in range(found):
        largest = max(largest, tree.found[i])
        equals -= tree.found[i] > least
    kept = 0
    for g in range(n_groups):
        for j in range(n_modes):
            for lane in range(WIDTH):
                total = tree.log_total[g, j, lane]
                if total > least or (total == least and equals > 0):
                    equals -= total == least
                    to, into = kept // WIDTH, kept % WIDTH
                    for e in range(sequences.mean.shape[2]):
                        sequences.mean[b, to, e, into] = tree.filters.mean[g, j, e, lane]
                    for t in range(sequences.covariance.shape[2]):
                        covariance = tree.filters.covariance[g, j, t, lane]
                        sequences.covariance[b, to, t, into] = covariance
                    for s in range(chain.mode.size):
                        weight = tree.log_weight[g, s, lane] - largest
                        sequences.log_weight[b, to, s, into] = (
                            weight if chain.mode[s] == j else -np.inf
                        )
                    kept += 1
    sequences.kept[b] = kept
    for rest in range(kept, -(-kept // WIDTH) * WIDTH):
        sequences.log_weight[b, rest // WIDTH, :, rest % WIDTH] = -np.inf


@row_kernel
def add_lanes(vector, lanes):
    store(lanes, 0, vector)
    total = 0.0
    for lane in range(WIDTH):
        total += lanes[lane]
    return total


@row_kernel
def combine(b, k, sequences, tree, work, chain, estimates):
    """The estimate of run b: mean, mode probabilities and, if wanted, the mixture's covariance.

    Beside the sequences that count there may be rubbish of weight 0, even NaN.
    """
    n_x, n_modes = sequences.mean.shape[2], tree.log_total.shape[1]
    n_groups = -(-sequences.kept[b] // WIDTH)
    mean, covariance = vectors(sequences.mean)[b], vectors(sequences.covariance)[b]
    log_weight, weight = vectors(sequences.log_weight)[b], vectors(tree.weight)
    bounded = estimates.final_mode_probability.shape[0] > 0
    everything, final = repeat(0.0), repeat(0.0)
    for j in range(n_modes):
        work.weight[j] = repeat(0.0)
    for e in range(n_x):
        work.row[e] = repeat(0.0)
    for g in range(n_groups):
        total = repeat(0.0)
        for s in range(chain.mode.size):
            share = exp(log_weight[g, s])
            total += share
            work.weight[chain.mode[s]] = work.weight[chain.mode[s]] + share
            if bounded:
                final += chain.final_probability[s] * share
        weight[g] = total
        everything += total
        for e in range(n_x):
            work.row[e] = work.row[e] + select(total > 0.0, total * mean[g, e], 0.0)
    scale = 1.0 / add_lanes(everything, tree.lanes)
    for j in range(n_modes):
        probability = scale * add_lanes(work.weight[j], tree.lanes)
        estimates.mode_probabilities[k, j, b] = probability
    if bounded:
        estimates.final_mode_probability[k, b] = scale * add_lanes(final, tree.lanes)
    for e in range(n_x):
        estimates.mean[k, e, b] = scale * add_lanes(work.row[e], tree.lanes)
    if estimates.covariance.shape[0]:
        t = 0
        for a in range(n_x):
            for c in range(a + 1):
                combined_a, combined_c = estimates.mean[k, a, b], estimates.mean[k, c, b]
                total = repeat(0.0)
                for g in range(n_groups):
                    spread = (mean[g, a] - combined_a) * (mean[g, c] - combined_c)
                    part = weight[g] * (covariance[g, t] + spread)
                    total += select(weight[g] > 0.0, part, 0.0)
                estimates.covariance[k, t, b] = scale * add_lanes(total, tree.lanes)
                t += 1


@lane_kernel
def advance(sequences, tree, workspace, model, chain, most, measurements, estimates, runs):
    """Runs from the first to before the last of `runs`, over a span of scans.

    measurements (n_steps, n_y, runs), NaN where missed. Two spans one after the other give the
    bytes of one.
    """
    work = in_vectors(workspace)
    for b in range(runs[0], runs[1]):
        for k in range(measurements.shape[0]):
            seen = repeat(0.0) == 0.0
            for m in range(measurements.shape[1]):
                work.scan[m] = repeat(measurements[k, m, b])
                # A scan with a missing component is missing as a whole.
                seen = seen & (work.scan[m] == work.scan[m])
            grow(b, k, sequences, tree, work, model, chain, seen)
            prune(b, sequences, tree, chain, most)
            combine(b, k, sequences, tree, work, chain, estimates)
