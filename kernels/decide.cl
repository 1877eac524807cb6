/* What a solver decides: the length of a step, the stars that follow it, and whether it is taken. */

/* Bonettini, Zanella & Zanni (2009), Inverse Problems 25, 015002: a step is shortened by the first
 * factor until the objective falls by at least the second of what the slope promises. Steps stay
 * within bounds; one that was shortened so often is lost in rounding.
 */
#define SHORTER ((real)0.4)
#define SUFFICIENT ((real)1e-4)
#define SHORTEST ((real)1e-5)
#define LONGEST ((real)1e5)
#define MAX_SHORTENINGS 12
/* A run has settled by the mean change over so many iterations: a step may be short by chance. */
#define CHANGE_WINDOW 10
/* Share of a star's flux that one step may take at most, and rounds of projections to that. */
#define MOST_FADING ((real)0.9)
#define N_ROUNDS 64
/* A star is as good as there within this share of its flux, and that of how far it was pushed. */
#define NEARLY ((real)1e-3)
#define PUSHED ((real)1e-6)
/* Why a run has ended. */
enum { PAUSED, SETTLED, STUCK, NOT_FINITE };

#define IS_FINITE(x) ((x) - (x) == 0)

/* The Barzilai-Borwein step <D y, s> / <D y, D y> of change_sums: longer where J bends down. */
INLINE real next_length(
    __global const real *steps, __global const real *change_sums, const int n_skies,
    __local real_sum *shared)
{
    const int n = ROW_BLOCKS * n_skies;
    const real_sum along = sum_group(sum_pairs(change_sums, n), shared);
    const real_sum squared = sum_group(sum_pairs(change_sums + 2 * n, n), shared);
    const real change_step = along.sum + along.lost, change_change = squared.sum + squared.lost;
    const real length =
        change_step > 0 && change_change > 0 ? change_step / change_change : 10 * steps[ALPHA];
    return min(max(length, SHORTEST), LONGEST);
}

/* The next step alpha: the smaller of the last two, or what the host gave for the first. */
INLINE real next_alpha(__global const real *steps, const real length)
{
    return steps[IS_FIRST] != 0 ? steps[ALPHA] : min(steps[LENGTH], length);
}

/* A star's part in the solution of the least squares within bounds: what is below its bound is
 * pushed there, and pushes the others, as far as it is below; a push never pulls.
 */
INLINE real lift_of(const real change, const real least, const real push, const real variance)
{
    return variance > 0 ? max((least - change) / variance, -push) : (real)0;
}

/* change: where <force, change> + <change, F change> / 2 is least with no flux falling by more than
 * MOST_FADING of it, by Hildreth's method (1957, Naval Research Logistics Quarterly 4, 79): from
 * -F^-1 force, which is there but for pushes at the bounds.
 */
INLINE void bounded_step(
    __global real *change, __global real *pushes, __global const real *force,
    __global const real *fluxes, __global const real *star_inverse, const int n_stars,
    __local real_sum *shared)
{
    FOR_EACH(s, n_stars)
        change[s] = pushes[s] = 0;
    for (int t = 0; t < n_stars; ++t) { /* by rows, which lie in one piece */
        FOR_EACH(s, n_stars)
            change[s] -= star_inverse[(size_t)t * n_stars + s] * force[t];
    }
    BARRIER;
    int n_rounds = N_ROUNDS;
    for (int round = 0; round < n_rounds; ++round) {
        real_sum away = {0, 0};
        for (int s = ITEM; s < n_stars; s += GROUP) {
            const real variance = star_inverse[(size_t)s * n_stars + s];
            const real lift = lift_of(change[s], -MOST_FADING * fluxes[s], pushes[s], variance);
            away.sum += fabs(lift) * variance > NEARLY * fluxes[s] + PUSHED * pushes[s] * variance;
        }
        away = sum_group(away, shared);
        n_rounds = away.sum > 0 ? n_rounds : 0;
        for (int t = 0; t < (n_rounds > 0 ? n_stars : 0); ++t) {
            const real lift = lift_of(
                change[t], -MOST_FADING * fluxes[t], pushes[t],
                star_inverse[(size_t)t * n_stars + t]);
            BARRIER;
            FOR_EACH(s, lift != 0 ? n_stars : 0)
                change[s] += lift * star_inverse[(size_t)t * n_stars + s];
            if (ITEM == 0)
                pushes[t] += lift;
            BARRIER;
        }
    }
    FOR_EACH(s, n_stars) { /* without the rounding of a long way back */
        const real least = -MOST_FADING * fluxes[s];
        change[s] = pushes[s] > 0 ? least : max(change[s], least);
    }
    BARRIER;
}

/* The gradient of the objective in a star's flux, the prior's with it. */
INLINE real flux_gradient(
    __global const real *fluxes, __global const real *star_totals,
    __global const real *prior_fluxes, __global const real *prior_precision, const int s)
{
    return prior_precision[s] * (fluxes[s] - prior_fluxes[s])
        - (star_totals[2 * s] + star_totals[2 * s + 1]);
}

/* c_s = c_s0 + share change_s: stars follow a step of the extended source to where they are best,
 * to second order, with the information F of the start, and a step that was shortened as far.
 * change = -F^-1 (gradient + <cross_information, sum_k flux_mixes_k d_k>) within bounds, d_k the step
 * of sky k; where that leads uphill, -F^-1 gradient.
 * gradient_s = -star_totals_s + prior_precision_s (c_s0 - prior_fluxes_s).
 * steps: the numbers of a run (precision.cl), updated: step lengths, slope, change of the prior.
 * star_fluxes: [n_stars], in: c_s0 or what was tried, out: c_s. star_steps: [4][n_stars], c_s0 and
 * change, kept between shorter and shorter steps, and two for what is on the way.
 * star_totals: [n_stars][2]. coupling_sums: [n_skies][n_stars][cross_blocks][2]. flux_mixes:
 * [n_stars][n_skies]. star_inverse: [n_stars][n_stars], F^-1. prior_fluxes, prior_precision: [n_stars].
 * step_sums: [n_skies][ROW_BLOCKS][2]. change_sums: [2][n_skies][ROW_BLOCKS][2].
 * Launch: one group. In place. Twin: reference.follow_stars.
 */
KERNEL void follow_stars(
    __global real *restrict steps, __global real *restrict star_fluxes,
    __global real *restrict star_steps, __global const real *restrict star_totals,
    __global const real *restrict coupling_sums, __global const real *restrict flux_mixes,
    __global const real *restrict star_inverse, __global const real *restrict prior_fluxes,
    __global const real *restrict prior_precision, __global const real *restrict step_sums,
    __global const real *restrict change_sums, const int n_skies, const int n_stars,
    const int cross_blocks)
{
    SHARED_SUMS(shared);
    OF_MEMBER(steps, N_NUMBERS);
    OF_MEMBER(star_fluxes, n_stars);
    OF_MEMBER(star_steps, 4 * n_stars);
    OF_MEMBER(star_totals, 2 * n_stars);
    OF_MEMBER(coupling_sums, n_skies * n_stars * cross_blocks * 2);
    OF_MEMBER(prior_fluxes, n_stars);
    OF_MEMBER(step_sums, 2 * ROW_BLOCKS * n_skies);
    OF_MEMBER(change_sums, 4 * ROW_BLOCKS * n_skies);
    __global real *before = star_steps, *change = before + n_stars;
    __global real *force = change + n_stars, *pushes = force + n_stars;
    const bool is_going = steps[GOING] != 0, is_new = steps[SHORTENED] == 0;
    const real length = next_length(steps, change_sums, n_skies, shared);
    const real alpha = next_alpha(steps, length);
    const bool is_first = steps[IS_FIRST] != 0;
    real share = steps[SHARE], slope = steps[SLOPE];
    const real_sum of_sky = sum_group(sum_pairs(step_sums, ROW_BLOCKS * n_skies), shared);
    int n_tries = is_going && is_new ? 2 : 0;
    for (int attempt = 0; attempt < n_tries; ++attempt) {
        real_sum along = {of_sky.sum, of_sky.lost}, own = {0, 0};
        FOR_EACH(s, n_stars) {
            if (attempt == 0)
                before[s] = star_fluxes[s];
            real pull = 0;
            for (int k = 0; k < (attempt == 0 ? n_skies : 0); ++k) {
                __global const real *pairs = coupling_sums + 2 * (k * n_stars + s) * cross_blocks;
                real_sum coupling = {0, 0};
                for (int b = 0; b < cross_blocks; ++b) {
                    const real_sum pair = {pairs[2 * b], pairs[2 * b + 1]};
                    MERGE(coupling, pair);
                }
                pull += flux_mixes[s * n_skies + k] * (coupling.sum + coupling.lost);
            }
            force[s] = flux_gradient(before, star_totals, prior_fluxes, prior_precision, s) + pull;
        }
        BARRIER;
        bounded_step(change, pushes, force, before, star_inverse, n_stars, shared);
        for (int s = ITEM; s < n_stars; s += GROUP) {
            const real gradient =
                flux_gradient(before, star_totals, prior_fluxes, prior_precision, s);
            ACCUMULATE(own, gradient * change[s]);
        }
        own = sum_group(own, shared);
        MERGE(along, own);
        slope = along.sum + along.lost;
        share = 1;
        n_tries = slope < 0 || n_stars == 0 ? 1 : n_tries;
        BARRIER;
    }
    real_sum prior_change = {0, 0};
    for (int s = ITEM; s < (is_going ? n_stars : 0); s += GROUP) {
        const real moved = share * change[s];
        star_fluxes[s] = before[s] + moved;
        ACCUMULATE(
            prior_change, prior_precision[s] * moved * (before[s] - prior_fluxes[s] + moved / 2));
    }
    prior_change = sum_group(prior_change, shared);
    BARRIER;
    if (ITEM == 0 && is_going) {
        steps[SHARE] = share;
        steps[SLOPE] = slope;
        steps[PRIOR_CHANGE] = prior_change.sum + prior_change.lost;
        if (is_new) {
            steps[ALPHA] = alpha;
            steps[LENGTH] = is_first ? steps[LENGTH] : length;
            steps[IS_FIRST] = 0;
        }
    }
}

/* Whether the objectives have settled, with that of entry n the last. */
INLINE bool has_settled(__global const real *steps, __global const real *objectives, const int n)
{
    if (n <= CHANGE_WINDOW || steps[TOLERANCE] == 0)
        return false;
    __global const real *last = objectives + 2 * n, *first = last - 2 * CHANGE_WINDOW;
    const real change = (last[0] - first[0]) + (last[1] - first[1]);
    return last[0] == 0
        || fabs(change) < steps[TOLERANCE] * CHANGE_WINDOW * fabs(last[0] + last[1]);
}

/* Takes or refuses a step by its objective, and tells whether the run continues. */
INLINE void decide(__global real *steps, __global real *objectives, const real_sum objective)
{
    const int n = steps[RECORDED];
    const real share = steps[SHARE];
    if (steps[GOING] == 0) {
        steps[FRESH] = 0;
        return;
    }
    if (share > 0) {
        __global const real *base = objectives + 2 * (n - 1);
        const real rise =
            (objective.sum - base[0]) + (objective.lost - base[1]) + steps[PRIOR_CHANGE];
        const real allowed =
            SUFFICIENT * share * steps[SLOPE] + steps[ROUNDING] * fabs(base[0] + base[1]);
        if (!(rise <= allowed)) {
            const bool is_lost = steps[SHORTENED] + 1 == MAX_SHORTENINGS;
            steps[FRESH] = 0;
            steps[SHORTENED] += 1;
            steps[SHARE] = SHORTER * share;
            steps[GOING] = !is_lost;
            steps[REASON] = !is_lost                                  ? PAUSED
                : IS_FINITE(objective.sum) && IS_FINITE(steps[SLOPE]) ? STUCK
                                                                      : NOT_FINITE;
            return;
        }
    }
    objectives[2 * n] = objective.sum;
    objectives[2 * n + 1] = objective.lost;
    const int reason = !IS_FINITE(objective.sum) ? NOT_FINITE
        : has_settled(steps, objectives, n)      ? SETTLED
                                                 : PAUSED;
    steps[RECORDED] = n + 1;
    steps[SHORTENED] = 0;
    steps[REASON] = reason;
    steps[GOING] = reason == PAUSED && n + 1 < steps[TARGET];
    steps[FRESH] = share > 0 ? (real)1 : steps[GOING];
}

/* J_0 = sum of the data terms; objective = J_0 + mu / 2 sum f^2 + the edge-preserving term;
 * star_totals_s = sum_j <P_js, r_j - w_j>; star_corrections_s = 1 + star_totals_s / star_weights_s,
 * not below 0 (negative PSF pixels). The step that led there is taken, and its objective recorded,
 * where that fell by SUFFICIENT of what the slope promises, the prior's change included.
 * steps: as above, updated: objectives recorded, shortenings and share, fresh, going, reason.
 * objectives: objectives_size reals, a compensated pair each; entry steps[RECORDED] is written.
 * data_term: [2], J_0. star_totals: [n_stars][2]. star_corrections, star_weights: [n_stars].
 * ratio_sums: [IMAGE_ROW_BLOCKS][n_images][2]. star_sums: [n_stars][n_images][star_blocks][2].
 * square_sums (mu not 0), smooth_sums (is_smoothed): [n_skies][ROW_BLOCKS][2].
 * Launch: up to n_stars groups, at least one. Out of place.
 * Twin: reference.collect_sums.
 */
KERNEL void collect_sums(
    __global real *restrict steps, __global real *restrict objectives,
    __global real *restrict data_term, __global real *restrict star_totals,
    __global real *restrict star_corrections, __global const real *restrict ratio_sums,
    __global const real *restrict star_sums, __global const real *restrict square_sums,
    __global const real *restrict smooth_sums, __global const real *restrict star_weights,
    const int is_smoothed, const real mu, const int n_images, const int n_skies, const int n_stars,
    const int star_blocks, const ulong objectives_size)
{
    SHARED_SUMS(shared);
    OF_MEMBER(steps, N_NUMBERS);
    OF_MEMBER(objectives, objectives_size);
    OF_MEMBER(data_term, 2);
    OF_MEMBER(star_totals, 2 * n_stars);
    OF_MEMBER(star_corrections, n_stars);
    OF_MEMBER(ratio_sums, IMAGE_ROW_BLOCKS * n_images * 2);
    OF_MEMBER(star_sums, (size_t)n_stars * n_images * star_blocks * 2);
    OF_MEMBER(square_sums, 2 * ROW_BLOCKS * n_skies);
    OF_MEMBER(smooth_sums, 2 * ROW_BLOCKS * n_skies);
    /* Every group makes the objective: a barrier in a branch stops PoCL. */
    const real_sum data = sum_group(sum_pairs(ratio_sums, IMAGE_ROW_BLOCKS * n_images), shared);
    real_sum objective = data;
    const int n_blocks = ROW_BLOCKS * n_skies;
    real_sum squares = sum_group(sum_pairs(square_sums, mu != 0 ? n_blocks : 0), shared);
    squares.sum *= mu / 2;
    squares.lost *= mu / 2;
    MERGE(objective, squares);
    const real_sum smooth = sum_group(sum_pairs(smooth_sums, is_smoothed ? n_blocks : 0), shared);
    MERGE(objective, smooth);
    if (get_group_id(0) == 0) {
        store_pair(data_term, data);
        if (ITEM == 0)
            decide(steps, objectives, objective);
    }
    const int n_units = n_images * star_blocks;
    for (int s = get_group_id(0); s < n_stars; s += get_num_groups(0)) {
        const real_sum star = sum_group(sum_pairs(star_sums + 2 * s * n_units, n_units), shared);
        store_pair(star_totals + 2 * s, star);
        const real correction = 1 + (star.sum + star.lost) / star_weights[s];
        if (ITEM == 0)
            star_corrections[s] = correction < 0 ? 0 : correction;
    }
}
