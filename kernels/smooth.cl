/* The edge-preserving term: the sum of (beta + beta') / 2 psi(f - f') over the pairs of pixels that share
 * an edge, round the grid's own edges too, psi(t) = sqrt(t^2 + delta^2) - delta.
 */

#define HAS_PENALTY (HAS_MU || HAS_SMOOTHING)

/* mu + curvature: a penalty's share of a denominator. */
INLINE vec penalty_weight(const real mu, const vec curvature)
{
#if HAS_SMOOTHING
    return mu + curvature;
#else
    return (vec)mu;
#endif
}

/* A point of slope or curvature, which only scenes that are smoothed have. */
INLINE cvec smoothing_at(__global const vec *smoothing, const int pixel)
{
#if HAS_SMOOTHING
    return LOAD(smoothing, pixel);
#else
    return (cvec){0, 0};
#endif
}

#if HAS_SMOOTHING

#if LANES == 1
#define LOAD_UNALIGNED(p) (*(p))
#else
#define LOAD_UNALIGNED(p) PASTE(vload, LANES)(0, p)
#endif

INLINE __global const real *row_of(
    __global const real *pixels, const int block, const int x, const int odd)
{
    return pixels + (((size_t)block * NX + x) * 2 + odd) * BLOCK;
}

/* The lanes of a row from `first` on, each shifted to the pair of rows above: that of the block's
 * first lane is the last one of the block before.
 */
INLINE vec lanes_above(
    __global const real *pixels, const int block, const int x, const int odd, const int first)
{
    union {
        vec v;
        real lanes[LANES];
    } above;
    above.v = LOAD_UNALIGNED(row_of(pixels, block, x, odd) + first - 1);
    if (first == 0)
        above.lanes[0] = row_of(pixels, (block + ROW_BLOCKS - 1) % ROW_BLOCKS, x, odd)[BLOCK - 1];
    return above.v;
}

/* Likewise to the pair of rows below. */
INLINE vec lanes_below(
    __global const real *pixels, const int block, const int x, const int odd, const int first)
{
    union {
        vec v;
        real lanes[LANES];
    } below;
    below.v = LOAD_UNALIGNED(row_of(pixels, block, x, odd) + first + 1);
    if (first == BLOCK - LANES)
        below.lanes[LANES - 1] = row_of(pixels, (block + 1) % ROW_BLOCKS, x, odd)[0];
    return below.v;
}

/* Adds the share of a pair of pixels of weight beta: beta psi'(t) and beta psi'(t) / t. */
INLINE void add_pair(vec *slope, vec *curvature, const vec beta, const vec t, const real delta)
{
    const vec share = beta / sqrt(t * t + delta * delta);
    *slope += t * share;
    *curvature += share;
}

/* psi(t), without the cancellation for small t. */
INLINE vec psi(const vec t, const real delta)
{
    return t * t / (sqrt(t * t + delta * delta) + delta);
}

/* slope = sum over the four neighbours of (beta + beta') / 2 psi'(f - f'),
 * curvature = the same sum of psi'(t) / t; smooth_sums: the sum of (beta + beta') / 2 psi over all pairs.
 * extended: one array of pixels, const, f. slope, curvature: one array of pixels each, written.
 * smoothing_map: one array of pixels, const, beta (HAS_SMOOTHING_MAP; else beta is the number
 * smoothing). smooth_sums: [ROW_BLOCKS][2]. edge: delta. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. Out of place. Twin: reference.smooth.
 */
KERNEL void smooth(
    __global vec *restrict slope, __global vec *restrict curvature,
    __global real *restrict smooth_sums, __global const vec *restrict extended,
    __global const vec *restrict smoothing_map, __global const real *restrict steps,
    const real smoothing, const real edge)
{
    SHARED_SUMS(shared);
    __global const real *pixels = (__global const real *)extended;
#if HAS_SMOOTHING_MAP
    __global const real *weights = (__global const real *)smoothing_map;
#endif
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        vec_sum total = {0, 0};
        FOR_EACH(piece, NX * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            const int left = (x + NX - 1) % NX, right = (x + 1) % NX;
            const cvec f = LOAD(extended + at + lane, x);
            const cvec f_left = LOAD(extended + at + lane, left);
            const cvec f_right = LOAD(extended + at + lane, right);
            const vec f_above = lanes_above(pixels, block, x, 1, lane * LANES);
            const vec f_below = lanes_below(pixels, block, x, 0, lane * LANES);
#if HAS_SMOOTHING_MAP
            const cvec b = LOAD(smoothing_map + at + lane, x);
            const cvec b_left = LOAD(smoothing_map + at + lane, left);
            const cvec b_right = LOAD(smoothing_map + at + lane, right);
            const vec b_above = lanes_above(weights, block, x, 1, lane * LANES);
            const vec b_below = lanes_below(weights, block, x, 0, lane * LANES);
#else
            const cvec b = {(vec)smoothing, (vec)smoothing}, b_left = b, b_right = b;
            const vec b_above = b.re, b_below = b.re;
#endif
            const vec right_re = (b.re + b_right.re) / 2, right_im = (b.im + b_right.im) / 2;
            const vec between = (b.re + b.im) / 2, below = (b.im + b_below) / 2;
            cvec s = {0, 0}, c = {0, 0};
            add_pair(&s.re, &c.re, (b.re + b_left.re) / 2, f.re - f_left.re, edge);
            add_pair(&s.im, &c.im, (b.im + b_left.im) / 2, f.im - f_left.im, edge);
            add_pair(&s.re, &c.re, right_re, f.re - f_right.re, edge);
            add_pair(&s.im, &c.im, right_im, f.im - f_right.im, edge);
            add_pair(&s.re, &c.re, (b.re + b_above) / 2, f.re - f_above, edge);
            add_pair(&s.im, &c.im, between, f.im - f.re, edge);
            add_pair(&s.re, &c.re, between, f.re - f.im, edge);
            add_pair(&s.im, &c.im, below, f.im - f_below, edge);
            STORE(slope + at + lane, x, s);
            STORE(curvature + at + lane, x, c);
            const vec across =
                right_re * psi(f.re - f_right.re, edge) + right_im * psi(f.im - f_right.im, edge);
            const vec down = between * psi(f.re - f.im, edge) + below * psi(f.im - f_below, edge);
            ACCUMULATE(total, across + down);
        }
        store_pair(smooth_sums + 2 * block, sum_group(sum_lanes(total), shared));
    }
}

#endif
