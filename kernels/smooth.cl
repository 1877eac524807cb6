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

/* The values of a pixel's own lanes and of its four neighbours; each pixel has two rows. */
typedef struct {
    cvec own, left, right;
    vec above, below;
} neighbours;

INLINE neighbours load_neighbours(
    __global const vec *restrict pixels, const int block, const int x, const int lane)
{
    __global const vec *row = pixels + (size_t)block * NX * 2 * SIDE + lane;
    __global const real *lanes = (__global const real *)pixels;
    neighbours n;
    n.own = LOAD(row, x);
    n.left = LOAD(row, (x + NX - 1) % NX);
    n.right = LOAD(row, (x + 1) % NX);
    n.above = lanes_above(lanes, block, x, 1, lane * LANES);
    n.below = lanes_below(lanes, block, x, 0, lane * LANES);
    return n;
}

/* The weights of a pixel's pairs: to the left, right, above and below, of both rows. */
typedef struct {
    cvec left, right, above, below;
} pair_weights;

INLINE pair_weights load_pair_weights(
    __global const vec *restrict smoothing_map, const real smoothing, const int block, const int x,
    const int lane)
{
    pair_weights beta;
#if HAS_SMOOTHING_MAP
    const neighbours b = load_neighbours(smoothing_map, block, x, lane);
    beta.left.re = (b.own.re + b.left.re) / 2;
    beta.left.im = (b.own.im + b.left.im) / 2;
    beta.right.re = (b.own.re + b.right.re) / 2;
    beta.right.im = (b.own.im + b.right.im) / 2;
    beta.above.re = (b.own.re + b.above) / 2;
    beta.above.im = (b.own.im + b.own.re) / 2;
    beta.below.re = beta.above.im;
    beta.below.im = (b.own.im + b.below) / 2;
#else
    const cvec same = {(vec)smoothing, (vec)smoothing};
    beta.left = beta.right = beta.above = beta.below = same;
#endif
    return beta;
}

/* slope = sum over the four neighbours of (beta + beta') / 2 psi'(f - f'),
 * curvature = the same sum of psi'(t) / t; smooth_sums: the sum of (beta + beta') / 2 psi over all pairs.
 * extended: one array of pixels, const, f. slope, curvature: one array of pixels each, written.
 * smoothing_map: one array of pixels, const, beta (HAS_SMOOTHING_MAP; else beta is the number
 * smoothing). smooth_sums: [ROW_BLOCKS][2]. edge: delta.
 * Launch: up to ROW_BLOCKS groups. Out of place. Twin: reference.smooth.
 */
KERNEL void smooth(
    __global vec *restrict slope, __global vec *restrict curvature,
    __global real *restrict smooth_sums, __global const vec *restrict extended,
    __global const vec *restrict smoothing_map, const real smoothing, const real edge)
{
    SHARED_SUMS(shared);
    FOR_EACH_BLOCK(block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        vec_sum total = {0, 0};
        FOR_EACH(piece, NX * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            const neighbours f = load_neighbours(extended, block, x, lane);
            const pair_weights beta = load_pair_weights(smoothing_map, smoothing, block, x, lane);
            cvec s = {0, 0}, c = {0, 0};
            add_pair(&s.re, &c.re, beta.left.re, f.own.re - f.left.re, edge);
            add_pair(&s.im, &c.im, beta.left.im, f.own.im - f.left.im, edge);
            add_pair(&s.re, &c.re, beta.right.re, f.own.re - f.right.re, edge);
            add_pair(&s.im, &c.im, beta.right.im, f.own.im - f.right.im, edge);
            add_pair(&s.re, &c.re, beta.above.re, f.own.re - f.above, edge);
            add_pair(&s.im, &c.im, beta.above.im, f.own.im - f.own.re, edge);
            add_pair(&s.re, &c.re, beta.below.re, f.own.re - f.own.im, edge);
            add_pair(&s.im, &c.im, beta.below.im, f.own.im - f.below, edge);
            STORE(slope + at + lane, x, s);
            STORE(curvature + at + lane, x, c);
            const vec across = beta.right.re * psi(f.own.re - f.right.re, edge)
                + beta.right.im * psi(f.own.im - f.right.im, edge);
            const vec down = beta.below.re * psi(f.own.re - f.own.im, edge)
                + beta.below.im * psi(f.own.im - f.below, edge);
            ACCUMULATE(total, across + down);
        }
        store_pair(smooth_sums + 2 * block, sum_group(sum_lanes(total), shared));
    }
}

#endif
