/* Windows of stars: arrays that differ from 0 in a few blocks of row pairs alone.
 *
 * A star has a window in each of n_arrays arrays: some columns of n_blocks blocks of pixels, from
 * block corners[w][0] and column corners[w][1] on, round the edges of the grid, where w is
 * s n_arrays + array; beyond it the array is 0. Windows lie one behind the other,
 * [n_stars][n_arrays], all with as many blocks and columns, and each block of one may have a sum:
 * [n_stars][n_arrays][n_blocks][2].
 *
 * The host lists the stars of each block: those whose windows in an array hold block b of row_blocks
 * are near[near[u]] to near[near[u + 1] - 1], with u = array row_blocks + b. So no work-item holds a
 * list, however many stars there are.
 */

/* Which block of all windows is block b of row_blocks, in window w. */
INLINE int window_block(
    __global const int *corners, const int w, const int n_blocks, const int b, const int row_blocks)
{
    const int ahead = b - corners[2 * w];
    return w * n_blocks + (ahead < 0 ? ahead + row_blocks : ahead);
}

#define WINDOW_BLOCK(windows, block, columns) ((windows) + (size_t)(block) * ((columns) * 2 * SIDE))

/* sums of each star near block b: of the products of its window and of z, a block of rows of nx. */
INLINE void sum_products(
    __global real *sums, const LINES z, __global const vec *windows, __global const int *corners,
    __global const int *near, const int n_arrays, const int array, const int n_blocks,
    const int n_columns, const int b, const int row_blocks, const int nx, __local real_sum *shared)
{
    const int unit = array * row_blocks + b;
    for (int at = near[unit]; at < near[unit + 1]; ++at) {
        const int w = near[at] * n_arrays + array;
        const int window = window_block(corners, w, n_blocks, b, row_blocks);
        __global const vec *star = WINDOW_BLOCK(windows, window, n_columns);
        vec_sum product = {0, 0};
        const int corner = corners[2 * w + 1];
        FOR_EACH_IN_WINDOW(i, corner, n_columns, nx) {
            const cvec p = LOAD(star + LANE_OF(i), COLUMN_OF(i, corner, nx));
            const cvec a = POINT(z, IN_LINES(i, corner, nx));
            ACCUMULATE(product, p.re * a.re + p.im * a.im);
        }
        store_pair(sums + 2 * window, sum_group(sum_lanes(product), shared));
    }
    BARRIER;
}
