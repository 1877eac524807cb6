/* Windows of stars: arrays that differ from 0 in a few blocks of row pairs alone.
 *
 * Of star s a window holds some columns of n_blocks blocks of pixels, from block corners[s][0] and
 * column corners[s][1] on, round the edges of the grid; beyond it the array is 0. Windows lie one
 * behind the other, [n_stars][n_arrays], all with as many blocks and columns, and each block of one
 * may have a sum: [n_stars][n_arrays][n_blocks][2].
 */

/* The stars whose windows hold one of row_blocks blocks of row pairs: their numbers, which block of all
 * windows that is, and its first column.
 */
#define NEAR_ROOM (MAX_STARS > 0 ? MAX_STARS : 1)
typedef struct {
    int count;
    int star[NEAR_ROOM];
    int block[NEAR_ROOM];
    int column[NEAR_ROOM];
} near_stars;

INLINE near_stars stars_near(
    __global const int *corners, const int n_stars, const int n_arrays, const int n_blocks,
    const int array, const int block, const int row_blocks)
{
    near_stars near;
    near.count = 0;
    /* The second bound lets compilers know that none or one star is all there is. */
    for (int s = 0; s < n_stars && s < MAX_STARS; ++s) {
        const int ahead = block - corners[2 * s], k = ahead < 0 ? ahead + row_blocks : ahead;
        if (k < n_blocks) {
            near.star[near.count] = s;
            near.column[near.count] = corners[2 * s + 1];
            near.block[near.count] = (s * n_arrays + array) * n_blocks + k;
            ++near.count;
        }
    }
    return near;
}

/* The column of a window that pixel x of a row of nx lies in; beyond its columns where there is none. */
INLINE int window_column(const int x, const int first, const int nx)
{
    return x < first ? x - first + nx : x - first;
}

#define WINDOW_BLOCK(windows, block, columns) ((windows) + (size_t)(block) * ((columns) * 2 * SIDE))
