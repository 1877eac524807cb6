/* The edge-preserving term: the sum of (beta + beta') / 2 psi(f - f') over the pairs of pixels that share
 * an edge, round the grid's own edges too, psi(t) = sqrt(t^2 + delta^2) - delta. Where there are several
 * skies each has a beta and a delta, and neighbours among them are pairs too.
 */

/* A point of slope or curvature, which only scenes that are smoothed have. The penalty is an argument, no
 * constant: the runs of one call differ in it, and each would compile all kernels.
 */
INLINE cvec smoothing_at(__global const vec *smoothing, const int pixel, const int is_smoothed)
{
    if (is_smoothed)
        return LOAD(smoothing, pixel);
    return (cvec){0, 0};
}

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

/* The slope and the curvature of a block of rows; this item's share of the sum of psi over the block's
 * pairs. It is called with a literal has_map, so that a number for beta costs no loads.
 */
INLINE vec_sum smooth_block(
    __global vec *slope, __global vec *curvature, __global const vec *extended,
    __global const vec *smoothing_map, const int has_map, const real smoothing, const real edge,
    const int block)
{
    __global const real *pixels = (__global const real *)extended;
    __global const real *weights = (__global const real *)smoothing_map;
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
        cvec b = {(vec)smoothing, (vec)smoothing}, b_left = b, b_right = b;
        vec b_above = b.re, b_below = b.re;
        if (has_map) {
            b = LOAD(smoothing_map + at + lane, x);
            b_left = LOAD(smoothing_map + at + lane, left);
            b_right = LOAD(smoothing_map + at + lane, right);
            b_above = lanes_above(weights, block, x, 1, lane * LANES);
            b_below = lanes_below(weights, block, x, 0, lane * LANES);
        }
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
    return total;
}

/* Adds the pairs of the pixels from `at` on with those of another sky to slope and curvature of the block;
 * this item's share of the sum of psi, of which the other sky has the other half.
 */
INLINE vec_sum smooth_between(
    __global vec *slope, __global vec *curvature, __global const vec *extended, const real beta,
    const real delta, const size_t at, const size_t other)
{
    vec_sum total = {0, 0};
    FOR_EACH(piece, NX * SIDE) {
        const int x = piece / SIDE, lane = piece % SIDE;
        const cvec f = LOAD(extended + at + lane, x), g = LOAD(extended + other + lane, x);
        cvec s = LOAD(slope + at + lane, x), c = LOAD(curvature + at + lane, x);
        add_pair(&s.re, &c.re, (vec)beta, f.re - g.re, delta);
        add_pair(&s.im, &c.im, (vec)beta, f.im - g.im, delta);
        STORE(slope + at + lane, x, s);
        STORE(curvature + at + lane, x, c);
        ACCUMULATE(total, beta / 2 * (psi(f.re - g.re, delta) + psi(f.im - g.im, delta)));
    }
    return total;
}

/* slope = sum over the four neighbours of (beta + beta') / 2 psi'(f - f') of each sky, and with the skies
 * before and behind it of spectral psi'(f - f'); curvature = the same sum of psi'(t) / t; smooth_sums:
 * the sum of (beta + beta') / 2 psi, or spectral psi, over all pairs.
 * extended: n_skies arrays of pixels, const, f. slope, curvature: n_skies arrays of pixels, written.
 * smoothing_map: n_skies arrays of pixels, const, beta (has_smoothing_map; else beta is
 * smoothing). smooth_sums: [n_skies][ROW_BLOCKS][2]. smoothing, edge: [n_skies], beta and delta > 0;
 * delta is the mean of two skies' between them. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups a sky. Out of place. Twin: reference.smooth.
 */
KERNEL void smooth(
    __global vec *restrict slope, __global vec *restrict curvature,
    __global real *restrict smooth_sums, __global const vec *restrict extended,
    __global const vec *restrict smoothing_map, __global const real *restrict steps,
    const int has_smoothing_map, __global const real *restrict smoothing,
    __global const real *restrict edge, const real spectral, const int n_skies)
{
    SHARED_SUMS(shared);
    OF_MEMBER(slope, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(curvature, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(smooth_sums, 2 * ROW_BLOCKS * n_skies);
    OF_MEMBER(extended, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, ROW_BLOCKS * n_skies) {
        const int sky = unit / ROW_BLOCKS, block = unit % ROW_BLOCKS;
        const size_t start = (size_t)sky * PIXELS_SIZE, at = (size_t)unit * NX * 2 * SIDE;
        __global vec *down = slope + start, *curved = curvature + start;
        __global const vec *f = extended + start, *map = smoothing_map + has_smoothing_map * start;
        vec_sum total;
        if (has_smoothing_map)
            total = smooth_block(down, curved, f, map, 1, smoothing[sky], edge[sky], block);
        else
            total = smooth_block(down, curved, f, map, 0, smoothing[sky], edge[sky], block);
        for (int k = max(sky - 1, 0); k < (spectral != 0 ? min(sky + 2, n_skies) : 0); ++k) {
            const size_t other = at + (size_t)k * PIXELS_SIZE - start;
            const real delta = (edge[sky] + edge[k]) / 2;
            vec_sum between = {0, 0};
            if (k != sky)
                between = smooth_between(slope, curvature, extended, spectral, delta, at, other);
            MERGE(total, between);
        }
        store_pair(smooth_sums + 2 * unit, sum_group(sum_lanes(total), shared));
    }
}
