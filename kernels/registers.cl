/* Lines in registers: the transforms of GPUs. Each of the LINE_ITEMS work-items of a line holds POINTS(n)
 * of its n points, ODD(n) times a power of two. Local memory is for exchanges alone, of real parts and
 * then of imaginary parts, so that a block takes half of the bytes that its points have.
 *
 * The outer pass is the odd one, and one of radix RADIX(n) = POINTS(n) / ODD(n) over each of its ODD(n)
 * parts. Others are of RADIX(n) too, but for the last. In a pass of radix R over subtransforms of
 * `length` points butterfly b takes these points of a part, w = length / R:
 *     b / w length + b % w + q w, 0 <= q < R.
 * Work-item j has butterflies j RADIX(n) / R to (j + 1) RADIX(n) / R - 1 of each part, one behind the
 * other in its registers. So it begins with points j + i LINE_ITEMS of the line, and ends in each part
 * with RADIX(n) that lie side by side in reversed order.
 *
 * Roots of unity: first exp(2 pi i k / ODD(n)), [ODD(n)][2] reals, and exp(-2 pi i k q / n) for
 * k < EVEN(n) and q = 1 .. ODD(n) - 1, [ODD(n) - 1][EVEN(n)][2], where ODD(n) is more than 1. Then, for
 * each pass but the last, exp(-2 pi i j 2^b / length), [log2(R)][w][2]: that of a leg is the product of
 * those of its bits.
 */

#if IN_REGISTERS

#define LINE_ITEMS (GROUP / BLOCK)
#define POINTS(n) ((n) / LINE_ITEMS)
#define RADIX(n) (POINTS(n) / ODD(n))
#define MAX_POINTS POINTS(NX > NY ? NX : NY)
#if LINE_ITEMS < 2 || LINE_ITEMS % OVERSAMPLE || RADIX(NX) % (2 * BLOCK)
#error "lines do not go into registers so"
#endif

typedef struct {
    cvec a[MAX_POINTS];
    __local real *exchange;
} lines;

#define LINES lines *
#define LINES_IN(z, scratch, points) \
    lines own_##z;                   \
    own_##z.exchange = scratch;      \
    LINES z = &own_##z
#define OF_LANE(z, lane) (z)

#define FOR_EACH_POINT(i, n) \
    UNROLL                   \
    for (int i = 0; i < POINTS(n); ++i)
#define LANE_OF(i) (ITEM % BLOCK)
#define OWN_LINE(p, i) ((p) + 2 * (ITEM / BLOCK) * SIDE + ITEM % BLOCK)
#define OWN_MAP(p, has_map, i) ((p) + 2 * (ITEM / BLOCK & -(has_map)) * SIDE + ITEM % BLOCK)
#define ALONG(i) ((i) * LINE_ITEMS)
#define PLACE_OF(i, n) ((i) / RADIX(n) * EVEN(n) + ITEM / BLOCK * RADIX(n) + (i) % RADIX(n))
#define POINT(z, i) ((z)->a[i])
#define SET_POINT(z, i, value) ((z)->a[i] = (value))
#define FOR_EACH_IN_WINDOW(i, corner, n_columns, n) \
    FOR_EACH_POINT(i, n)                            \
        if (COLUMN_OF(i, corner, n) < (n_columns))
#define COLUMN_OF(i, corner, n) column_of(ITEM / BLOCK + (i) * LINE_ITEMS, corner, n)
#define IN_LINES(i, corner, n) (i)

INLINE int column_of(const int pixel, const int corner, const int n)
{
    return pixel < corner ? pixel - corner + n : pixel - corner;
}

#define POINT_OF_SKY(z, i, q) ((z)->a[(i) * OVERSAMPLE + (q)])
#define POINT_OF_IMAGE(z, i) ((z)->a[(i) / OVERSAMPLE])
/* OTFs lie in the order of registers, side by side for the items of a group. */
#define OTF_POINT(k, i, q, share, place)                    \
    ((cvec){                                                \
        (k)[2 * ((i) * (share) + (q)) * GROUP + ITEM],      \
        (k)[(2 * ((i) * (share) + (q)) + 1) * GROUP + ITEM] \
    })
#define SET_OTF_POINT(k, i, place, value)               \
    do {                                                \
        (k)[2 * (i) * GROUP + ITEM] = (value).re;       \
        (k)[(2 * (i) + 1) * GROUP + ITEM] = (value).im; \
    } while (0)

/* A block of columns is held in registers too. */
#define HELD_LINES LINES
#define SCRATCH_POINTS NY
#define LINES_AND_HELD(z, held, scratch, columns) \
    LINES_IN(held, scratch, NY);                  \
    LINES_IN(z, scratch, NY)
#define FIRST_HELD(z, held) held
#define HOLD(held, z)
#define TAKE_HELD(z, held)
#define HELD_OR(held, other) held

/* Where a point of a line lies in the exchange: with one number of padding in 16 passes meet few bank
 * conflicts.
 */
INLINE int in_exchange(const int place)
{
    return (place + place / 16) * BLOCK;
}

/* The point of a line that register i of item j has in a pass. It is that of register 0 and that of item
 * 0, added up: they have no bit in common. So the addresses of an item are one, and constants.
 */
INLINE int point_in_pass(const int j, const int i, const int n, const int length, const int radix)
{
    const int width = length / radix, part = i / RADIX(n);
    const int b = j * (RADIX(n) / radix) + i % RADIX(n) / radix;
    return part * EVEN(n) + b / width * length + b % width + i % radix * width;
}

INLINE __local real *exchanged(
    const LINES z, const int i, const int n, const int length, const int radix)
{
    return z->exchange + ITEM % BLOCK
        + in_exchange(point_in_pass(ITEM / BLOCK, 0, n, length, radix))
        + in_exchange(point_in_pass(0, i, n, length, radix));
}

/* Puts the real parts of lines, or the imaginary ones, into the exchange in the order of a pass. */
INLINE void put(const LINES z, const int n, const bool im, const int length, const int radix)
{
    UNROLL
    for (int i = 0; i < POINTS(n); ++i)
        *exchanged(z, i, n, length, radix) = im ? z->a[i].im : z->a[i].re;
}

/* Takes them from there. What an item takes it alone writes over next, in the same order. */
INLINE void take(LINES z, const int n, const bool im, const int length, const int radix)
{
    UNROLL
    for (int i = 0; i < POINTS(n); ++i) {
        const real part = *exchanged(z, i, n, length, radix);
        if (im)
            z->a[i].im = part;
        else
            z->a[i].re = part;
    }
}

/* From the order of one pass to that of another. */
INLINE void reorder(
    LINES z, const int n, const int length, const int radix, const int next_length,
    const int next_radix)
{
    put(z, n, false, length, radix);
    BARRIER;
    take(z, n, false, next_length, next_radix);
    BARRIER;
    put(z, n, true, length, radix);
    BARRIER;
    take(z, n, true, next_length, next_radix);
}

/* Puts column 0 into the exchange, which has room for both parts of one line, if this is its block. */
INLINE void show_column_0(const LINES z, const int n, const int block)
{
    if (block != 0)
        return;
    BARRIER;
    if (ITEM % BLOCK == 0) {
        UNROLL
        for (int i = 0; i < POINTS(n); ++i) {
            z->exchange[2 * PLACE_OF(i, n)] = z->a[i].re;
            z->exchange[2 * PLACE_OF(i, n) + 1] = z->a[i].im;
        }
    }
    BARRIER;
}

/* Of column 0 that is shown the opposite of point i of the sky, where one point of the lines stands for
 * `share`: the first item has those of its points, others have them from one item, in reverse.
 */
INLINE scalar opposite_point(const LINES z, const int i, const int share)
{
    const int j = ITEM / BLOCK, radix = RADIX(NY), part = i / radix;
    const int other = part > 0 ? LINE_ITEMS - 1 - j : j > 0 ? j ^ (HIGH_BIT(j) - 1) : 0;
    const int from = (part > 0 ? ODD(NY) - part : 0) * EVEN(NY) + radix - 1 - i % radix;
    __local const real *shown = z->exchange + 2 * (other * (radix / share)) + 2 * (from / share);
    const int own = opposite_place(i, NY) / share;
    if (part > 0 || j > 0)
        return (scalar){shown[0], shown[1]};
    return (scalar){z->a[own].re, z->a[own].im};
}
#define OWN_OF_COLUMN_0(z, i, place) ((scalar){(z)->a[i].re, (z)->a[i].im})
#define OPPOSITE_HELD(held, i, place) opposite_point(held, i, 1)
#define OPPOSITE(z, i, place, share) opposite_point(z, i, share)

/* The roots of the pass over subtransforms of `length` points; `roots` is the table for n. */
INLINE __global const real *roots_of(__global const real *roots, const int n, const int length)
{
    if (ODD(n) > 1)
        roots += 2 * ODD(n) + 2 * (ODD(n) - 1) * EVEN(n);
    UNROLL
    for (int l = EVEN(n); l > length; l /= RADIX(n))
        roots += 2 * LOG2(RADIX(n)) * (l / RADIX(n));
    return roots;
}

/* Legs times the roots of butterfly j of a pass, or with sign -1 times their conjugates. */
INLINE void twiddle(
    cvec *a, const int radix, __global const real *roots, const int j, const int width,
    const real sign)
{
    UNROLL
    for (int bit = radix / 2; bit > 0; bit /= 2, roots += 2 * width) {
        const real re = roots[2 * j], im = sign * roots[2 * j + 1];
        UNROLL
        for (int q = bit; q < radix; ++q) {
            if (q & bit)
                a[q] = rotate(a[q], re, im);
        }
    }
}

/* The root's number for butterfly s of an item. */
#define NUMBER(n, s, radix, width) \
    ((ITEM / BLOCK * (RADIX(n) / (radix)) + (s) % (RADIX(n) / (radix))) % (width))

/* A pass of radix `radix` over subtransforms of `length` points. */
INLINE void dif_pass(
    LINES z, const int n, const int length, const int radix, __global const real *roots)
{
    const int width = length / radix;
    UNROLL
    for (int s = 0; s < POINTS(n) / radix; ++s) {
        cvec *a = z->a + s * radix;
        dif(a, radix);
        if (width > 1)
            twiddle(a, radix, roots_of(roots, n, length), NUMBER(n, s, radix, width), width, 1);
    }
}

INLINE void dit_pass(
    LINES z, const int n, const int length, const int radix, __global const real *roots)
{
    const int width = length / radix;
    UNROLL
    for (int s = 0; s < POINTS(n) / radix; ++s) {
        cvec *a = z->a + s * radix;
        if (width > 1)
            twiddle(a, radix, roots_of(roots, n, length), NUMBER(n, s, radix, width), width, -1);
        dit(a, radix);
    }
}

/* The outer pass, in place: the odd one, and one of radix RADIX(n) over each of its parts. */
INLINE void dif_outer(cvec *a, const int n, __global const real *roots)
{
    const int j = ITEM / BLOCK, radix = RADIX(n), odd = ODD(n);
    __global const real *turns = roots + 2 * odd;
    UNROLL
    for (int s = 0; s < (odd > 1 ? radix : 0); ++s) {
        cvec legs[MAX_ODD];
        UNROLL
        for (int q = 0; q < odd; ++q)
            legs[q] = a[s + q * radix];
        dft_odd(legs, odd, -1, roots);
        a[s] = legs[0];
        UNROLL
        for (int q = 1; q < odd; ++q) {
            __global const real *root = turns + 2 * ((q - 1) * EVEN(n) + j + s * LINE_ITEMS);
            a[s + q * radix] = rotate(legs[q], root[0], root[1]);
        }
    }
    UNROLL
    for (int q = 0; q < odd; ++q) {
        dif(a + q * radix, radix);
        twiddle(a + q * radix, radix, roots_of(roots, n, EVEN(n)), j, LINE_ITEMS, 1);
    }
}

INLINE void dit_outer(cvec *a, const int n, __global const real *roots)
{
    const int j = ITEM / BLOCK, radix = RADIX(n), odd = ODD(n);
    __global const real *turns = roots + 2 * odd;
    UNROLL
    for (int q = 0; q < odd; ++q) {
        twiddle(a + q * radix, radix, roots_of(roots, n, EVEN(n)), j, LINE_ITEMS, -1);
        dit(a + q * radix, radix);
    }
    UNROLL
    for (int s = 0; s < (odd > 1 ? radix : 0); ++s) {
        cvec legs[MAX_ODD];
        legs[0] = a[s];
        UNROLL
        for (int q = 1; q < odd; ++q) {
            __global const real *root = turns + 2 * ((q - 1) * EVEN(n) + j + s * LINE_ITEMS);
            legs[q] = rotate(a[s + q * radix], root[0], -root[1]);
        }
        dft_odd(legs, odd, 1, roots);
        UNROLL
        for (int q = 0; q < odd; ++q)
            a[s + q * radix] = legs[q];
    }
}

/* Everything behind the outer pass of the forward transform. */
INLINE void dif_inner(LINES z, const int n, __global const real *roots)
{
    int before = EVEN(n), radix = RADIX(n);
    UNROLL
    for (int length = LINE_ITEMS; length > LAST(n); length /= RADIX(n)) {
        reorder(z, n, before, radix, length, RADIX(n));
        dif_pass(z, n, length, RADIX(n), roots);
        before = length;
        radix = RADIX(n);
    }
    reorder(z, n, before, radix, LAST(n), LAST(n));
    dif_pass(z, n, LAST(n), LAST(n), roots);
}

/* Everything before the outer pass of the inverse transform. */
INLINE void dit_inner(LINES z, const int n, __global const real *roots)
{
    int before = LAST(n), radix = LAST(n);
    dit_pass(z, n, LAST(n), LAST(n), roots);
    UNROLL
    for (int length = LAST(n) * RADIX(n); length <= LINE_ITEMS; length *= RADIX(n)) {
        reorder(z, n, before, radix, length, RADIX(n));
        dit_pass(z, n, length, RADIX(n), roots);
        before = length;
        radix = RADIX(n);
    }
    reorder(z, n, before, radix, EVEN(n), RADIX(n));
}

/* The outer pass over n points of a line, of which an item has one butterfly. */

#define MAX_OUTER MAX_POINTS

INLINE void load_inverse(
    cvec *a, const LINES z, const int x, const int n, __global const real *roots)
{
    UNROLL
    for (int q = 0; q < POINTS(n); ++q)
        a[q] = z->a[q];
    dit_outer(a, n, roots);
}

INLINE void store_forward(LINES z, cvec *a, const int x, const int n, __global const real *roots)
{
    dif_outer(a, n, roots);
    UNROLL
    for (int q = 0; q < POINTS(n); ++q)
        z->a[q] = a[q];
}

INLINE void finish_rows(LINES z, const int n, __global const real *roots)
{
    dit_outer(z->a, n, roots);
}

INLINE void begin_rows(LINES z, const int n, __global const real *roots)
{
    dif_outer(z->a, n, roots);
}

/* Sums of the OVERSAMPLE frequencies that are one in an image, neighbours in reversed order. */
INLINE LINES fold_rows(LINES z)
{
    if (OVERSAMPLE > 1)
        BARRIER; /* the points of an image have other places in the exchange */
    FOR_EACH_POINT(i, IMAGE_NX) {
        cvec a = POINT_OF_SKY(z, i, 0);
        UNROLL
        for (int q = 1; q < OVERSAMPLE; ++q)
            a = add(a, POINT_OF_SKY(z, i, q));
        z->a[i] = a;
    }
    return z;
}

#endif
