/* An FFT of n = ODD(n) EVEN(n) points, ODD(n) 1, 3, 5, 7 or 9 and EVEN(n) a power of two: one odd
 * pass (odd.cl), and radix-2 butterflies, up to three deep in registers.
 *
 * Forward: decimation in frequency, natural order in, reversed order out, exp(-2 pi i ...).
 * Inverse: decimation in time, reversed order in, natural order out, exp(+2 pi i ...), not
 * divided by the length. So no reversal is ever done; spectra stay in reversed order: with r the
 * bit-reversed order of EVEN(n) points, place q EVEN(n) + t has k = ODD(n) r(t) + q.
 *
 * A transform of n points has an outer pass of radix OUTER(n), which the kernels write themselves
 * because it is where data come and go: the odd one, or else one of radix 8 at most. Then follow,
 * over subtransforms of INNER(n) points, passes of radix 8, and a last pass of radix LAST(n) <= 8.
 * All are in place. Where INNER(n) is more than CHUNK points, one middle pass goes over everything;
 * what is left is done span by span, so that each SPAN(n) points stay in the nearest cache until
 * they are done.
 *
 * Roots of unity: first exp(2 pi i k / ODD(n)), [ODD(n)][2] reals, where ODD(n) is more than 1. Then
 * twiddles, for each pass over subtransforms of `length` points with radix R, in the order in which
 * the forward transform needs them: [length / R][R - 1][2] reals, exp(-2 pi i j reversed(q) / length)
 * for j and q = 1 .. R - 1. The last pass needs none.
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
#define MAX_OUTER MAX_ODD /* more than 8, the most where there is no odd pass */
#define INNER(n) ((n) / OUTER(n))
#define HAS_MIDDLE(n) (INNER(n) > LAST(n) && INNER(n) > CHUNK)
#define SPAN_LENGTH(n) (HAS_MIDDLE(n) ? INNER(n) / 8 : INNER(n))
#define SPAN(n) (GROUP > 1 ? (n) : SPAN_LENGTH(n))

#define HIGH_BIT(i) (1 << (31 - clz(i)))

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

INLINE void butterfly(cvec *a, cvec *b)
{
    const cvec difference = subtract(*a, *b);
    *a = add(*a, *b);
    *b = difference;
}

/* Radix 1, 2, 4 or 8. */
INLINE void dif(cvec *a, const int radix)
{
    if (radix == 8) {
        UNROLL
        for (int i = 0; i < 4; ++i)
            butterfly(a + i, a + i + 4);
        a[5] = rotate(a[5], SQRT_HALF, -SQRT_HALF);
        a[6] = times_minus_i(a[6]);
        a[7] = rotate(a[7], -SQRT_HALF, -SQRT_HALF);
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
    if (radix == 8) {
        a[5] = rotate(a[5], SQRT_HALF, SQRT_HALF);
        a[6] = times_i(a[6]);
        a[7] = rotate(a[7], -SQRT_HALF, SQRT_HALF);
        UNROLL
        for (int i = 0; i < 4; ++i)
            butterfly(a + i, a + i + 4);
    }
}

/* The butterflies of the outer pass. */
INLINE void dif_outer(cvec *a, const int n, __global const real *roots)
{
    if (ODD(n) > 1)
        dft_odd(a, ODD(n), -1, roots);
    else
        dif(a, OUTER(n));
}

INLINE void dit_outer(cvec *a, const int n, __global const real *roots)
{
    if (ODD(n) > 1)
        dft_odd(a, ODD(n), 1, roots);
    else
        dit(a, OUTER(n));
}

INLINE void twiddle_forward(cvec *a, const int radix, __global const real *roots)
{
    UNROLL
    for (int q = 1; q < radix; ++q)
        a[q] = rotate(a[q], roots[2 * q - 2], roots[2 * q - 1]);
}

INLINE void twiddle_inverse(cvec *a, const int radix, __global const real *roots)
{
    UNROLL
    for (int q = 1; q < radix; ++q)
        a[q] = rotate(a[q], roots[2 * q - 2], -roots[2 * q - 1]);
}

/* The roots of the pass over subtransforms of `length` points; `roots` is the table for n. */
INLINE __global const real *roots_of(__global const real *roots, const int n, const int length)
{
    if (ODD(n) > 1)
        roots += 2 * ODD(n);
    if (length < n)
        roots += 2 * INNER(n) * (OUTER(n) - 1);
    UNROLL
    for (int l = INNER(n); l > length; l /= 8)
        roots += 14 * (l / 8);
    return roots;
}

/* A pass of radix 8 over `total` points in subtransforms of `length`. */
INLINE void dif_pass(SCRATCH vec *x, const int total, const int length, __global const real *roots)
{
    const int eighth = length / 8;
    FOR_EACH(piece, total / 8 * SIDE) {
        const int j = piece / SIDE % eighth;
        SCRATCH vec *leg = x + 2 * SIDE * (piece / SIDE / eighth * length + j) + piece % SIDE;
        cvec a[8];
        UNROLL
        for (int q = 0; q < 8; ++q)
            a[q] = LOAD(leg, q * eighth);
        dif(a, 8);
        twiddle_forward(a, 8, roots + 14 * j);
        UNROLL
        for (int q = 0; q < 8; ++q)
            STORE(leg, q * eighth, a[q]);
    }
    BARRIER;
}

INLINE void dit_pass(SCRATCH vec *x, const int total, const int length, __global const real *roots)
{
    const int eighth = length / 8;
    FOR_EACH(piece, total / 8 * SIDE) {
        const int j = piece / SIDE % eighth;
        SCRATCH vec *leg = x + 2 * SIDE * (piece / SIDE / eighth * length + j) + piece % SIDE;
        cvec a[8];
        UNROLL
        for (int q = 0; q < 8; ++q)
            a[q] = LOAD(leg, q * eighth);
        twiddle_inverse(a, 8, roots + 14 * j);
        dit(a, 8);
        UNROLL
        for (int q = 0; q < 8; ++q)
            STORE(leg, q * eighth, a[q]);
    }
    BARRIER;
}

INLINE void dif_middle(SCRATCH vec *x, const int n, __global const real *roots)
{
    if (HAS_MIDDLE(n))
        dif_pass(x, n, INNER(n), roots_of(roots, n, INNER(n)));
}

INLINE void dit_middle(SCRATCH vec *x, const int n, __global const real *roots)
{
    if (HAS_MIDDLE(n))
        dit_pass(x, n, INNER(n), roots_of(roots, n, INNER(n)));
}

/* The passes over one span, all but the last. */
INLINE void dif_span(SCRATCH vec *x, const int n, __global const real *roots)
{
    for (int length = SPAN_LENGTH(n); length > LAST(n); length /= 8)
        dif_pass(x, SPAN(n), length, roots_of(roots, n, length));
}

INLINE void dit_span(SCRATCH vec *x, const int n, __global const real *roots)
{
    for (int length = 8 * LAST(n); length <= SPAN_LENGTH(n); length *= 8)
        dit_pass(x, SPAN(n), length, roots_of(roots, n, length));
}

/* The last pass of the forward transform, over one span. */
INLINE void dif_last(SCRATCH vec *x, const int n)
{
    FOR_EACH(piece, SPAN(n) / LAST(n) * SIDE) {
        SCRATCH vec *leg = x + 2 * SIDE * (piece / SIDE * LAST(n)) + piece % SIDE;
        cvec a[8];
        UNROLL
        for (int q = 0; q < LAST(n); ++q)
            a[q] = LOAD(leg, q);
        dif(a, LAST(n));
        UNROLL
        for (int q = 0; q < LAST(n); ++q)
            STORE(leg, q, a[q]);
    }
    BARRIER;
}

/* The first pass of the inverse transform, over one span. */
INLINE void dit_first(SCRATCH vec *x, const int n)
{
    FOR_EACH(piece, SPAN(n) / LAST(n) * SIDE) {
        SCRATCH vec *leg = x + 2 * SIDE * (piece / SIDE * LAST(n)) + piece % SIDE;
        cvec a[8];
        UNROLL
        for (int q = 0; q < LAST(n); ++q)
            a[q] = LOAD(leg, q);
        dit(a, LAST(n));
        UNROLL
        for (int q = 0; q < LAST(n); ++q)
            STORE(leg, q, a[q]);
    }
    BARRIER;
}

/* Everything behind the outer pass of the forward transform. */
INLINE void dif_inner(SCRATCH vec *x, const int n, __global const real *roots)
{
    dif_middle(x, n, roots);
    for (int start = 0; start < n; start += SPAN(n)) {
        dif_span(x + 2 * SIDE * start, n, roots);
        dif_last(x + 2 * SIDE * start, n);
    }
}

/* Everything before the outer pass of the inverse transform. */
INLINE void dit_inner(SCRATCH vec *x, const int n, __global const real *roots)
{
    for (int start = 0; start < n; start += SPAN(n)) {
        dit_first(x + 2 * SIDE * start, n);
        dit_span(x + 2 * SIDE * start, n, roots);
    }
    dit_middle(x, n, roots);
}
