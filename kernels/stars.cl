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

/* The pixel of a row of nx in which a column of window w lies. */
INLINE int window_pixel(__global const int *corners, const int w, const int column, const int nx)
{
    const int pixel = corners[2 * w + 1] + column;
    return pixel < nx ? pixel : pixel - nx;
}

#define WINDOW_BLOCK(windows, block, columns) ((windows) + (size_t)(block) * ((columns) * 2 * SIDE))

/* sums of each star near block b: of the products of its window and of z, a block of rows of nx. */
INLINE void sum_products(
    __global real *sums, SCRATCH const vec *z, __global const vec *windows,
    __global const int *corners, __global const int *near, const int n_arrays, const int array,
    const int n_blocks, const int n_columns, const int b, const int row_blocks, const int nx,
    __local real_sum *shared)
{
    const int unit = array * row_blocks + b;
    for (int i = near[unit]; i < near[unit + 1]; ++i) {
        const int w = near[i] * n_arrays + array;
        const int window = window_block(corners, w, n_blocks, b, row_blocks);
        __global const vec *star = WINDOW_BLOCK(windows, window, n_columns);
        vec_sum product = {0, 0};
        FOR_EACH(piece, n_columns * SIDE) {
            const int column = piece / SIDE, lane = piece % SIDE;
            const int pixel = window_pixel(corners, w, column, nx);
            const cvec a = LOAD(z + lane, pixel), p = LOAD(star + lane, column);
            ACCUMULATE(product, p.re * a.re + p.im * a.im);
        }
        store_pair(sums + 2 * window, sum_group(sum_lanes(product), shared));
    }
    BARRIER;
}
