/* The edge-preserving term: the sum of (beta + beta') / 2 psi(f - f') over the pairs of pixels that share
 * an edge, round the grid's own edges too, psi(t) = sqrt(t^2 + delta^2) - delta.
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

/* slope = sum over the four neighbours of (beta + beta') / 2 psi'(f - f'),
 * curvature = the same sum of psi'(t) / t; smooth_sums: the sum of (beta + beta') / 2 psi over all pairs.
 * extended: one array of pixels, const, f. slope, curvature: one array of pixels each, written.
 * smoothing_map: one array of pixels, const, beta (has_smoothing_map; else beta is the number
 * smoothing). smooth_sums: [ROW_BLOCKS][2]. edge: delta. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. Out of place. Twin: reference.smooth.
 */
KERNEL void smooth(
    __global vec *restrict slope, __global vec *restrict curvature,
    __global real *restrict smooth_sums, __global const vec *restrict extended,
    __global const vec *restrict smoothing_map, __global const real *restrict steps,
    const int has_smoothing_map, const real smoothing, const real edge)
{
    SHARED_SUMS(shared);
    OF_MEMBER(slope, PIXELS_SIZE);
    OF_MEMBER(curvature, PIXELS_SIZE);
    OF_MEMBER(smooth_sums, 2 * ROW_BLOCKS);
    OF_MEMBER(extended, PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        vec_sum total;
        if (has_smoothing_map)
            total =
                smooth_block(slope, curvature, extended, smoothing_map, 1, smoothing, edge, block);
        else
            total =
                smooth_block(slope, curvature, extended, smoothing_map, 0, smoothing, edge, block);
        store_pair(smooth_sums + 2 * block, sum_group(sum_lanes(total), shared));
    }
}
