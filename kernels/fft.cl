/* An FFT of n = ODD(n) EVEN(n) points, ODD(n) 1, 3, 5, 7 or 9 and EVEN(n) a power of two: one odd
 * pass (odd.cl), and radix-2 butterflies, up to four deep in registers.
 *
 * Forward: decimation in frequency, natural order in, reversed order out, exp(-2 pi i ...).
 * Inverse: decimation in time, reversed order in, natural order out, exp(+2 pi i ...), not
 * divided by the length. So no reversal is ever done; spectra stay in reversed order: with r the
 * bit-reversed order of EVEN(n) points, place q EVEN(n) + t has k = ODD(n) r(t) + q.
 *
 * A transform of n points has an outer pass of radix OUTER(n), where data come and go, passes over
 * subtransforms of INNER(n) points, and a last one of radix LAST(n). All are in place. scratch.cl has
 * them on a block in memory, and registers.cl in registers: lines (LINES) under the same names.
 *
 * Kernels write the outer pass themselves, or go over the points of their lines:
 *   FOR_EACH_POINT(i, n)   i: a point of lines of n points that this work-item has
 *   POINT(z, i), SET_POINT(z, i, value)   that point
 *   LANE_OF(i)             its column, or pair of rows, of the block
 *   OWN_LINE(p, i), ALONG(i)   where its line begins, or this work-item's points of it, in pixels from p
 *                          on, and which point from there it is; OWN_MAP: of a map, or of one point
 *   PLACE_OF(i, n)         and its place in reversed order, of a spectrum
 *   FOR_EACH_IN_WINDOW(i, corner, n_columns, n)   those in a window, from column `corner` of the line on,
 *                          round its end
 *   COLUMN_OF(i, corner, n), IN_LINES(i, corner, n)   the window's column, and i of the point
 */

#define IS_ROW(n) ((n) == NX || (n) == IMAGE_NX)
#define ODD(n) (IS_ROW(n) ? ROW_ODD : COLUMN_ODD)
#define EVEN(n) ((n) / ODD(n))
#define OUTER(n)                                \
    ((n) == NX                ? ROW_OUTER       \
            : (n) == IMAGE_NX ? IMAGE_ROW_OUTER \
            : (n) == NY       ? COLUMN_OUTER    \
                              : IMAGE_COLUMN_OUTER)
#define LAST(n)                                \
    ((n) == NX                ? ROW_LAST       \
            : (n) == IMAGE_NX ? IMAGE_ROW_LAST \
            : (n) == NY       ? COLUMN_LAST    \
                              : IMAGE_COLUMN_LAST)
#define INNER(n) ((n) / OUTER(n))

#define LOG2(i) (31 - clz(i))
#define HIGH_BIT(i) (1 << LOG2(i))

/* The place of -k, where `place` has k: places EVEN(n) to n, and 2^b to 2^(b + 1) below, have the
 * opposites of each other in reversed order.
 */
INLINE int opposite_place(const int place, const int n)
{
    if (place < 2)
        return place;
    return place < EVEN(n) ? place ^ (HIGH_BIT(place) - 1) : n + EVEN(n) - 1 - place;
}

#define SQRT_HALF ((real)0.70710678118654752440)
/* Cosine and sine of an eighth of pi. */
#define COS_EIGHTH ((real)0.92387953251128675613)
#define SIN_EIGHTH ((real)0.38268343236508977173)

INLINE void butterfly(cvec *a, cvec *b)
{
    const cvec difference = subtract(*a, *b);
    *a = add(*a, *b);
    *b = difference;
}

/* Radix 1, 2, 4, 8 or 16. */
INLINE void dif(cvec *a, const int radix)
{
    if (radix == 16) {
        UNROLL
        for (int i = 0; i < 8; ++i)
            butterfly(a + i, a + i + 8);
        a[9] = rotate(a[9], COS_EIGHTH, -SIN_EIGHTH);
        a[10] = rotate(a[10], SQRT_HALF, -SQRT_HALF);
        a[11] = rotate(a[11], SIN_EIGHTH, -COS_EIGHTH);
        a[12] = times_minus_i(a[12]);
        a[13] = rotate(a[13], -SIN_EIGHTH, -COS_EIGHTH);
        a[14] = rotate(a[14], -SQRT_HALF, -SQRT_HALF);
        a[15] = rotate(a[15], -COS_EIGHTH, -SIN_EIGHTH);
    }
    if (radix >= 8) {
        UNROLL
        for (int s = 0; s < radix; s += 8) {
            UNROLL
            for (int i = s; i < s + 4; ++i)
                butterfly(a + i, a + i + 4);
            a[s + 5] = rotate(a[s + 5], SQRT_HALF, -SQRT_HALF);
            a[s + 6] = times_minus_i(a[s + 6]);
            a[s + 7] = rotate(a[s + 7], -SQRT_HALF, -SQRT_HALF);
        }
    }
    if (radix >= 4) {
        UNROLL
        for (int s = 0; s < radix; s += 4) {
            butterfly(a + s, a + s + 2);
            butterfly(a + s + 1, a + s + 3);
            a[s + 3] = times_minus_i(a[s + 3]);
        }
    }
    if (radix >= 2) {
        UNROLL
        for (int s = 0; s < radix; s += 2)
            butterfly(a + s, a + s + 1);
    }
}

/* The steps of dif backwards, with conjugate roots. */
INLINE void dit(cvec *a, const int radix)
{
    if (radix >= 2) {
        UNROLL
        for (int s = 0; s < radix; s += 2)
            butterfly(a + s, a + s + 1);
    }
    if (radix >= 4) {
        UNROLL
        for (int s = 0; s < radix; s += 4) {
            a[s + 3] = times_i(a[s + 3]);
            butterfly(a + s, a + s + 2);
            butterfly(a + s + 1, a + s + 3);
        }
    }
    if (radix >= 8) {
        UNROLL
        for (int s = 0; s < radix; s += 8) {
            a[s + 5] = rotate(a[s + 5], SQRT_HALF, SQRT_HALF);
            a[s + 6] = times_i(a[s + 6]);
            a[s + 7] = rotate(a[s + 7], -SQRT_HALF, SQRT_HALF);
            UNROLL
            for (int i = s; i < s + 4; ++i)
                butterfly(a + i, a + i + 4);
        }
    }
    if (radix == 16) {
        a[9] = rotate(a[9], COS_EIGHTH, SIN_EIGHTH);
        a[10] = rotate(a[10], SQRT_HALF, SQRT_HALF);
        a[11] = rotate(a[11], SIN_EIGHTH, COS_EIGHTH);
        a[12] = times_i(a[12]);
        a[13] = rotate(a[13], -SIN_EIGHTH, COS_EIGHTH);
        a[14] = rotate(a[14], -SQRT_HALF, SQRT_HALF);
        a[15] = rotate(a[15], -COS_EIGHTH, SIN_EIGHTH);
        UNROLL
        for (int i = 0; i < 8; ++i)
            butterfly(a + i, a + i + 8);
    }
}
