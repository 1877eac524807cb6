/* The edge-preserving term: beta sum of psi(f - f') over the pairs of pixels that share an edge, round
 * the grid's own edges too, psi(t) = sqrt(t^2 + delta^2) - delta.
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

/* Adds what the pair of a pixel and its neighbour has: psi'(t) and psi'(t) / t. */
INLINE void add_pair(vec *slope, vec *curvature, const vec t, const real delta)
{
    const vec inverse = 1 / sqrt(t * t + delta * delta);
    *slope += t * inverse;
    *curvature += inverse;
}

/* psi(t), without the cancellation for small t. */
INLINE vec psi(const vec t, const real delta)
{
    return t * t / (sqrt(t * t + delta * delta) + delta);
}

/* slope = beta sum over the four neighbours of psi'(f - f'), curvature = beta sum of psi'(t) / t;
 * smooth_sums: beta sum of psi over all pairs.
 * extended: one array of pixels, const, f. slope, curvature: one array of pixels each, written.
 * smooth_sums: [ROW_BLOCKS][2]. smoothing: beta. edge: delta.
 * Launch: up to ROW_BLOCKS groups. Out of place. Twin: reference.smooth.
 */
KERNEL void smooth(
    __global vec *restrict slope, __global vec *restrict curvature,
    __global real *restrict smooth_sums, __global const vec *restrict extended,
    const real smoothing, const real edge)
{
    SHARED_SUMS(shared);
    __global const real *pixels = (__global const real *)extended;
    FOR_EACH_BLOCK(block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        vec_sum total = {0, 0};
        FOR_EACH(piece, NX * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            const cvec f = LOAD(extended + at + lane, x);
            const cvec left = LOAD(extended + at + lane, (x + NX - 1) % NX);
            const cvec right = LOAD(extended + at + lane, (x + 1) % NX);
            const vec above = lanes_above(pixels, block, x, 1, lane * LANES);
            const vec below = lanes_below(pixels, block, x, 0, lane * LANES);
            cvec s = {0, 0}, c = {0, 0};
            add_pair(&s.re, &c.re, f.re - left.re, edge);
            add_pair(&s.im, &c.im, f.im - left.im, edge);
            add_pair(&s.re, &c.re, f.re - right.re, edge);
            add_pair(&s.im, &c.im, f.im - right.im, edge);
            add_pair(&s.re, &c.re, f.re - above, edge);
            add_pair(&s.im, &c.im, f.im - f.re, edge);
            add_pair(&s.re, &c.re, f.re - f.im, edge);
            add_pair(&s.im, &c.im, f.im - below, edge);
            const cvec scaled_slope = {smoothing * s.re, smoothing * s.im};
            const cvec scaled_curvature = {smoothing * c.re, smoothing * c.im};
            STORE(slope + at + lane, x, scaled_slope);
            STORE(curvature + at + lane, x, scaled_curvature);
            const vec across = psi(f.re - right.re, edge) + psi(f.im - right.im, edge);
            const vec down = psi(f.re - f.im, edge) + psi(f.im - below, edge);
            ACCUMULATE(total, smoothing * (across + down));
        }
        store_pair(smooth_sums + 2 * block, sum_group(sum_lanes(total), shared));
    }
}

#endif
