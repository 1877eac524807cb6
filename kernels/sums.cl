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

/* An infinite sum has lost nothing: two-sum would make it NaN. */
INLINE void store_pair(__global real *out, const real_sum total)
{
    out[0] = total.sum;
    out[1] = isinf(total.sum) ? 0 : total.lost;
}

/* Sums the lanes and writes the pair to out[0], out[1]. */
INLINE void store_sum(__global real *out, const vec_sum total)
{
    union { vec v; real lanes[LANES]; } sum = {total.sum}, lost = {total.lost};
    real_sum all = {0, 0};
    UNROLL
    for (int l = 0; l < LANES; ++l) {
        ACCUMULATE(all, sum.lanes[l]);
        all.lost += lost.lanes[l];
    }
    store_pair(out, all);
}

/* The sum of n pairs, `stride` reals apart. */
INLINE real_sum sum_pairs(__global const real *pairs, const int n, const int stride)
{
    real_sum all = {0, 0};
    for (int i = 0; i < n; ++i) {
        ACCUMULATE(all, pairs[i * stride]);
        all.lost += pairs[i * stride + 1];
    }
    return all;
}

#define N_SUMS (1 + N_STARS)

/* objective = sum of the data terms + mu / 2 sum f^2;
 * star_corrections_s = sum <P_js, r_j> / star_weights_s, not below 0 (negative PSF pixels).
 * objectives: [iterations][2], a compensated pair each; entry `iteration` is written.
 * ratio_sums: [ROW_BLOCKS][N_IMAGES][GROUP][N_SUMS][2]; square_sums: [ROW_BLOCKS][GROUP][2].
 * star_corrections, star_weights: [N_STARS].
 * Launch: one work-item. Out of place. Twin: reference.collect_sums.
 */
__kernel __attribute__((reqd_work_group_size(1, 1, 1))) void collect_sums(
    __global real *restrict objectives, __global real *restrict star_corrections,
    __global const real *restrict ratio_sums, __global const real *restrict square_sums,
    __global const real *restrict star_weights, const real mu, const int iteration)
{
    const int n = ROW_BLOCKS * N_IMAGES * GROUP;
    real_sum objective = sum_pairs(ratio_sums, n, 2 * N_SUMS);
#if HAS_MU
    const real_sum squares = sum_pairs(square_sums, ROW_BLOCKS * GROUP, 2);
    ACCUMULATE(objective, mu / 2 * squares.sum);
    objective.lost += mu / 2 * squares.lost;
#endif
    store_pair(objectives + 2 * iteration, objective);
    for (int s = 0; s < N_STARS; ++s) {
        const real_sum star = sum_pairs(ratio_sums + 2 * (1 + s), n, 2 * N_SUMS);
        const real correction = (star.sum + star.lost) / star_weights[s];
        star_corrections[s] = correction < 0 ? 0 : correction;
    }
}
