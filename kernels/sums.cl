/* Compensated sums: each is a pair, the sum and what rounding took from it. Sums over pixels are
 * made in them throughout, so that no device needs double precision for a single-precision run.
 */

typedef struct {
    vec sum, lost;
} vec_sum;

typedef struct {
    real sum, lost;
} real_sum;

/* Knuth's two-sum: exact in any rounding to nearest. */
#define ACCUMULATE(total, value)                                            \
    do {                                                                    \
        const __typeof__((total).sum) value_ = (value), old_ = (total).sum; \
        (total).sum = old_ + value_;                                        \
        const __typeof__((total).sum) part_ = (total).sum - old_;           \
        (total).lost += (old_ - ((total).sum - part_)) + (value_ - part_);  \
    } while (0)

#define MERGE(total, other)               \
    do {                                  \
        ACCUMULATE((total), (other).sum); \
        (total).lost += (other).lost;     \
    } while (0)

INLINE real_sum sum_lanes(const vec_sum total)
{
    union {
        vec v;
        real lanes[LANES];
    } sum = {total.sum}, lost = {total.lost};
    real_sum all = {0, 0};
    UNROLL
    for (int l = 0; l < LANES; ++l) {
        const real_sum lane = {sum.lanes[l], lost.lanes[l]};
        MERGE(all, lane);
    }
    return all;
}

/* A place in local memory, in the kernel's outermost block, where a group's items meet. */
#if GROUP > 1
#define SHARED_SUMS(name) __local real_sum name[GROUP]
#else
#define SHARED_SUMS(name) __local real_sum *const name = 0
#endif

/* The sum of what the items of a group have, by halves; every item gets it. */
INLINE real_sum sum_group(real_sum own, __local real_sum *shared)
{
#if GROUP > 1
    shared[ITEM] = own;
    BARRIER;
    for (int count = GROUP / 2; count > 0; count /= 2) {
        if (ITEM < count) {
            own = shared[ITEM];
            MERGE(own, shared[ITEM + count]);
            shared[ITEM] = own;
        }
        BARRIER;
    }
    own = shared[0];
    BARRIER;
#endif
    return own;
}

/* Writes a pair to out[0], out[1]. */
INLINE void store_pair(__global real *out, const real_sum total)
{
    if (ITEM == 0) {
        out[0] = total.sum;
        out[1] = total.lost;
    }
}

/* This item's share of the sum of n pairs. */
INLINE real_sum sum_pairs(__global const real *pairs, const int n)
{
    real_sum all = {0, 0};
    for (int i = ITEM; i < n; i += GROUP) {
        const real_sum pair = {pairs[2 * i], pairs[2 * i + 1]};
        MERGE(all, pair);
    }
    return all;
}

/* J_0 = sum of the data terms; objective = J_0 + mu / 2 sum f^2 + the edge-preserving term;
 * star_totals_s = sum_j <P_js, r_j - w_j>; star_corrections_s = 1 + star_totals_s / star_weights_s,
 * not below 0 (negative PSF pixels).
 * objectives: [iterations][2], a compensated pair each; entry `iteration` is written.
 * data_term: [2], J_0. star_totals: [n_stars][2]. star_corrections, star_weights: [n_stars].
 * ratio_sums: [IMAGE_ROW_BLOCKS][n_images][2]. star_sums: [n_stars][n_images][star_blocks][2].
 * square_sums (HAS_MU), smooth_sums (HAS_SMOOTHING): [ROW_BLOCKS][2].
 * Launch: up to n_stars groups, at least one. Out of place.
 * Twin: reference.collect_sums.
 */
KERNEL void collect_sums(
    __global real *restrict objectives, __global real *restrict data_term,
    __global real *restrict star_totals, __global real *restrict star_corrections,
    __global const real *restrict ratio_sums, __global const real *restrict star_sums,
    __global const real *restrict square_sums, __global const real *restrict smooth_sums,
    __global const real *restrict star_weights, const real mu, const int n_images,
    const int n_stars, const int star_blocks, const int iteration)
{
    SHARED_SUMS(shared);
    /* Every group makes the objective: a barrier in a branch stops PoCL. */
    const real_sum data = sum_group(sum_pairs(ratio_sums, IMAGE_ROW_BLOCKS * n_images), shared);
    real_sum objective = data;
#if HAS_MU
    real_sum squares = sum_group(sum_pairs(square_sums, ROW_BLOCKS), shared);
    squares.sum *= mu / 2;
    squares.lost *= mu / 2;
    MERGE(objective, squares);
#endif
#if HAS_SMOOTHING
    const real_sum smooth = sum_group(sum_pairs(smooth_sums, ROW_BLOCKS), shared);
    MERGE(objective, smooth);
#endif
    if (get_group_id(0) == 0) {
        store_pair(data_term, data);
        store_pair(objectives + 2 * iteration, objective);
    }
    const int n_units = n_images * star_blocks;
    FOR_EACH_BLOCK(s, n_stars) {
        const real_sum star = sum_group(sum_pairs(star_sums + 2 * s * n_units, n_units), shared);
        store_pair(star_totals + 2 * s, star);
        const real correction = 1 + (star.sum + star.lost) / star_weights[s];
        if (ITEM == 0)
            star_corrections[s] = correction < 0 ? 0 : correction;
    }
}
