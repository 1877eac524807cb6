/* Lines in the scratch, local or global memory: the transforms of CPUs, in vectors, and of groups whose
 * lines do not go into registers.
 *
 * The outer pass is the odd one, or else one of radix 8 at most; then come passes of radix 8, and LAST(n)
 * is at most 8. Where INNER(n) is more than CHUNK points, one middle pass goes over everything; what is
 * left is done span by span, so that each SPAN(n) points stay in the nearest cache until they are done.
 *
 * Roots of unity: first exp(2 pi i k / ODD(n)), [ODD(n)][2] reals, where ODD(n) is more than 1. Then
 * twiddles, for each pass over subtransforms of `length` points with radix R, in the order in which
 * the forward transform needs them: [length / R][R - 1][2] reals, exp(-2 pi i j reversed(q) / length)
 * for j and q = 1 .. R - 1. The last pass needs none.
 */

#if !IN_REGISTERS

#define MAX_OUTER MAX_ODD /* the odd pass has the largest radix */
#define HAS_MIDDLE(n) (INNER(n) > LAST(n) && INNER(n) > CHUNK)
#define SPAN_LENGTH(n) (HAS_MIDDLE(n) ? INNER(n) / 8 : INNER(n))
#define SPAN(n) (GROUP > 1 ? (n) : SPAN_LENGTH(n))

#define LINES SCRATCH vec *
#define LINES_IN(z, scratch, points) SCRATCH vec *z = OWN_SCRATCH(scratch, points)
/* The lines of one lane, of which butterflies of the outer pass are taken. */
#define OF_LANE(z, lane) ((z) + (lane))

#define FOR_EACH_POINT(i, n) FOR_EACH(i, (n) * SIDE)
#define LANE_OF(i) ((i) % SIDE)
#define OWN_LINE(p, i) ((p) + (i) % SIDE)
#define OWN_MAP(p, has_map, i) OWN_LINE(p, i)
#define ALONG(i) ((i) / SIDE)
#define PLACE_OF(i, n) ((i) / SIDE)
#define POINT(z, i) LOAD((z) + (i) % SIDE, (i) / SIDE)
#define SET_POINT(z, i, value) STORE((z) + (i) % SIDE, (i) / SIDE, value)
#define FOR_EACH_IN_WINDOW(i, corner, n_columns, n) FOR_EACH(i, (n_columns) * SIDE)
#define COLUMN_OF(i, corner, n) ((i) / SIDE)
#define IN_LINES(i, corner, n) (in_line((corner) + (i) / SIDE, n) * SIDE + (i) % SIDE)

INLINE int in_line(const int pixel, const int n)
{
    return pixel < n ? pixel : pixel - n;
}

/* In reversed order point q of a sky of those that are one of an image, and the image's for one of a sky. */
#define POINT_OF_SKY(z, i, q) LOAD((z) + (i) % SIDE, (i) / SIDE * OVERSAMPLE + (q))
#define POINT_OF_IMAGE(z, i) LOAD((z) + (i) % SIDE, (i) / SIDE / OVERSAMPLE)
/* The point of an OTF at a place, for point q of `share` that are point i of a line. */
#define OTF_POINT(k, i, q, share, place) LOAD((k) + (i) % SIDE, place)
#define SET_OTF_POINT(k, i, place, value) STORE((k) + (i) % SIDE, place, value)

/* A block of columns is held while it goes through the images: in the scratch where that has room for
 * two blocks, else in array 0 of the spectra, or by HELD_OR in another. The lines that are to be held
 * are made in FIRST_HELD.
 */
#if SCRATCH_BLOCKS > 1
#define HELD SCRATCH
#define SCRATCH_POINTS (NY + IMAGE_NY)
#define LINES_AND_HELD(z, held, scratch, columns)             \
    SCRATCH vec *held = OWN_SCRATCH(scratch, SCRATCH_POINTS); \
    SCRATCH vec *z = held + 2 * NY * SIDE
#define FIRST_HELD(z, held) held
#define HOLD(held, z)
#define TAKE_HELD(z, held)
#define HELD_OR(held, other) held
#else
#define HELD __global
#define SCRATCH_POINTS NY
#define LINES_AND_HELD(z, held, scratch, columns) \
    __global vec *held = columns;                 \
    SCRATCH vec *z = OWN_SCRATCH(scratch, SCRATCH_POINTS)
#define FIRST_HELD(z, held) z
#define HOLD(held, z) COPY_COLUMNS(held, z)
#define TAKE_HELD(z, held) COPY_COLUMNS(z, held)
#define HELD_OR(held, other) other
#define COPY_COLUMNS(to, from)     \
    do {                           \
        FOR_EACH(i, NY * 2 * SIDE) \
            (to)[i] = (from)[i];   \
        BARRIER;                   \
    } while (0)
#endif
#define HELD_LINES HELD vec *

/* Column 0 of a block in reversed order: real and imaginary part of the point at a place and of its
 * opposite, where one point of the lines stands for `share`.
 */
#define OF_COLUMN_0(space, z, place)                           \
    ((scalar){                                                 \
        ((space const real *)(z))[2 * (place) * BLOCK],        \
        ((space const real *)(z))[2 * (place) * BLOCK + BLOCK] \
    })
#define show_column_0(z, n, block)
#define OWN_OF_COLUMN_0(z, i, place) OF_COLUMN_0(SCRATCH, z, place)
#define OPPOSITE_HELD(held, i, place) OF_COLUMN_0(HELD, held, opposite_place(place, NY))
#define OPPOSITE(z, i, place, share) OF_COLUMN_0(SCRATCH, z, opposite_place(place, NY) / (share))

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

/* The outer pass over n points of a block: leg q of butterfly x is point x + q INNER(n). */

INLINE void load_inverse(
    cvec *a, SCRATCH const vec *z, const int x, const int n, __global const real *roots)
{
    UNROLL
    for (int q = 0; q < OUTER(n); ++q)
        a[q] = LOAD(z, q * INNER(n) + x);
    twiddle_inverse(a, OUTER(n), roots_of(roots, n, n) + 2 * (OUTER(n) - 1) * x);
    dit_outer(a, n, roots);
}

INLINE void store_forward(
    SCRATCH vec *z, cvec *a, const int x, const int n, __global const real *roots)
{
    dif_outer(a, n, roots);
    twiddle_forward(a, OUTER(n), roots_of(roots, n, n) + 2 * (OUTER(n) - 1) * x);
    UNROLL
    for (int q = 0; q < OUTER(n); ++q)
        STORE(z, q * INNER(n) + x, a[q]);
}

/* Those passes in place, over all points of a block. */

INLINE void finish_rows(SCRATCH vec *z, const int n, __global const real *roots)
{
    FOR_EACH(piece, INNER(n) * SIDE) {
        const int x = piece / SIDE, lane = piece % SIDE;
        cvec a[MAX_OUTER];
        load_inverse(a, z + lane, x, n, roots);
        UNROLL
        for (int q = 0; q < OUTER(n); ++q)
            STORE(z + lane, q * INNER(n) + x, a[q]);
    }
    BARRIER;
}

INLINE void begin_rows(SCRATCH vec *z, const int n, __global const real *roots)
{
    FOR_EACH(piece, INNER(n) * SIDE) {
        const int x = piece / SIDE, lane = piece % SIDE;
        cvec a[MAX_OUTER];
        UNROLL
        for (int q = 0; q < OUTER(n); ++q)
            a[q] = LOAD(z + lane, q * INNER(n) + x);
        store_forward(z + lane, a, x, n, roots);
    }
    BARRIER;
}

/* Sums of the OVERSAMPLE frequencies that are one in an image, neighbours in reversed order. */
INLINE LINES fold_rows(LINES z)
{
#if OVERSAMPLE == 1
    return z;
#else
    SCRATCH vec *folded = z + 2 * SIDE * NX;
    FOR_EACH(piece, IMAGE_NX * SIDE) {
        const int t = piece / SIDE, lane = piece % SIDE;
        cvec a = LOAD(z + lane, t * OVERSAMPLE);
        UNROLL
        for (int q = 1; q < OVERSAMPLE; ++q)
            a = add(a, LOAD(z + lane, t * OVERSAMPLE + q));
        STORE(folded + lane, t, a);
    }
    BARRIER;
    return folded;
#endif
}

#endif
