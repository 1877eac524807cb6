/* Windows of stars: arrays that differ from 0 in a few blocks of row pairs alone.
 *
 * Of star s a window holds n_blocks blocks of pixels, from block first_blocks_s on, round the edge of
 * the grid; beyond them the array is 0. Windows lie one behind the other, [n_stars][n_arrays], and
 * each block of one may have a sum: [n_stars][n_arrays][n_blocks][2].
 */

/* The stars whose windows hold a block of row pairs: their numbers, and which block of all windows
 * that is.
 */
#define NEAR_ROOM (MAX_STARS > 0 ? MAX_STARS : 1)
typedef struct {
    int count;
    int star[NEAR_ROOM];
    int block[NEAR_ROOM];
} near_stars;

INLINE near_stars stars_near(
    __global const int *first_blocks, const int n_stars, const int n_arrays, const int n_blocks,
    const int array, const int block)
{
    near_stars near;
    near.count = 0;
    /* The second bound lets compilers know that none or one star is all there is. */
    for (int s = 0; s < n_stars && s < MAX_STARS; ++s) {
        const int ahead = block - first_blocks[s], k = ahead < 0 ? ahead + ROW_BLOCKS : ahead;
        if (k < n_blocks) {
            near.star[near.count] = s;
            near.block[near.count] = (s * n_arrays + array) * n_blocks + k;
            ++near.count;
        }
    }
    return near;
}

#define WINDOW_BLOCK(windows, block) ((windows) + (size_t)(block) * (NX * 2 * SIDE))
