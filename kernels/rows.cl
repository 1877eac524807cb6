/* Transforms along the rows: pixels to and from half spectra along x, two rows at a time.
 *
 * Row pair (a, b) is transformed as the complex row z = a + i b. Its spectrum Z holds both: with
 * X, Y the half spectra of a and b, Z(k) = X(k) + i Y(k) and Z(-k) = conj(X(k)) + i conj(Y(k)).
 * Half spectra keep one of each pair (k, -k), column h of them that at place(h) of the reversed
 * order; its opposite lies at opposite(h). X(0) and X(Nx / 2) are real and share column 0 as its
 * real and imaginary part; they lie at places 0 and 1.
 */

/* How far column h + i, i < LANES, lies before its place, where `shift` is that of h, a multiple of
 * LANES: its highest bit, or half of EVEN(NX) if that is less.
 */
#define BIT(i) ((i) < 2 ? 1 : (i) < 4 ? 2 : (i) < 8 ? 4 : 8)
#define COLUMN_SHIFT(h, i, shift) ((h) == 0 ? BIT(i) : (shift))
#define SHIFT(h) (ODD(NX) > 1 ? min(HIGH_BIT(h), EVEN(NX) / 2) : HIGH_BIT(h))

INLINE int place(const int h, const int i, const int shift)
{
    return h + i + COLUMN_SHIFT(h, i, shift);
}

INLINE int opposite(const int h, const int i, const int shift)
{
    if (ODD(NX) > 1 && shift == EVEN(NX) / 2)
        return NX + EVEN(NX) - 1 - place(h, i, shift);
    return place(h, i, shift) ^ (2 * COLUMN_SHIFT(h, i, shift) - 1);
}

INLINE vec zip_low(const vec a, const vec b)
{
#if LANES == 1
    return a;
#else
    vec zipped;
    zipped.even = a.lo;
    zipped.odd = b.lo;
    return zipped;
#endif
}

INLINE vec zip_high(const vec a, const vec b)
{
#if LANES == 1
    return a;
#else
    vec zipped;
    zipped.even = a.hi;
    zipped.odd = b.hi;
    return zipped;
#endif
}

/* Transposes LANES x LANES: log2(LANES) rounds that interleave rows i and i + LANES / 2. */
INLINE void transpose(vec *a)
{
    UNROLL
    for (int round = 1; round < LANES; round *= 2) {
        vec b[LANES];
        UNROLL
        for (int i = 0; i < LANES / 2; ++i) {
            b[2 * i] = zip_low(a[i], a[i + LANES / 2]);
            b[2 * i + 1] = zip_high(a[i], a[i + LANES / 2]);
        }
        UNROLL
        for (int i = 0; i < LANES; ++i)
            a[i] = b[i];
    }
}

/* Where rows 2 BLOCK block + ... of the spectra begin in column block c. */
INLINE size_t tile_start(const int block, const int column_block)
{
    return ((size_t)column_block * ROWS + 2 * BLOCK * block) * 2 * SIDE;
}

/* The four arrays that a tile is made of, on either side: real and imaginary part of X and Y, in
 * memory 0 to 3; real and imaginary part of Z(k) and Z(-k). Each of one side is the sum or the
 * difference of two of the other, tabled here as (first, second, sign of the second).
 */
__constant int READ_FIRST[4] = {0, 1, 0, 2}, READ_SECOND[4] = {3, 2, 3, 1};
__constant real READ_SIGN[4] = {-1, 1, 1, -1};
__constant int WRITE_FIRST[4] = {0, 1, 1, 2}, WRITE_SECOND[4] = {2, 3, 3, 0};
__constant real WRITE_SIGN[4] = {1, -1, 1, -1};

/* Tiles lie far from each other in memory, so no processor foresees the next one. */
#define TILES_AHEAD 2

INLINE void prefetch_tile(__global const vec *tile)
{
    UNROLL
    for (int i = 0; i < 4 * LANES; ++i)
        PREFETCH(tile + i * SIDE);
}

/* Half spectra of one block of row pairs -> Z in the scratch, in reversed order. */
INLINE void read_tiles(SCRATCH vec *z, __global const vec *spectra, const int block)
{
    FOR_EACH(piece, COLUMN_BLOCKS * SIDE * SIDE) {
        const int column = piece % SIDE, pair = piece / SIDE % SIDE, tile = piece / SIDE / SIDE;
        const int h = tile * BLOCK + column * LANES;
        const int shift = SHIFT(h);
        const int offset = 4 * LANES * pair * SIDE + column;
        __global const vec *x = spectra + tile_start(block, tile) + offset;
        if (tile + TILES_AHEAD < COLUMN_BLOCKS)
            prefetch_tile(spectra + tile_start(block, tile + TILES_AHEAD) + offset);
        for (int part = 0; part < 4; ++part) {
            __global const vec *first = x + READ_FIRST[part] * SIDE;
            __global const vec *second = x + READ_SECOND[part] * SIDE;
            vec a[LANES];
            UNROLL
            for (int l = 0; l < LANES; ++l)
                a[l] = first[4 * l * SIDE] + READ_SIGN[part] * second[4 * l * SIDE];
            transpose(a);
            SCRATCH vec *to = z + part % 2 * SIDE + pair;
            UNROLL
            for (int i = 0; i < LANES; ++i) {
                const int at = part < 2 ? place(h, i, shift) : opposite(h, i, shift);
                to[2 * at * SIDE] = a[i];
            }
        }
    }
    BARRIER;
    FOR_EACH(pair, BLOCK) {
        __global const real *x =
            (__global const real *)(spectra + tile_start(block, 0)) + 4 * pair * BLOCK;
        SCRATCH real *first = (SCRATCH real *)z + pair;
        first[0] = x[0];
        first[BLOCK] = x[2 * BLOCK];
        first[2 * BLOCK] = x[BLOCK];
        first[3 * BLOCK] = x[3 * BLOCK];
    }
    BARRIER;
}

/* Z in the scratch, in reversed order -> twice the half spectra of its row pairs; one point of Z
 * stands for `share` points of them.
 */
INLINE void write_tiles(
    __global vec *spectra, SCRATCH const vec *z, const int block, const int share)
{
    FOR_EACH(piece, COLUMN_BLOCKS * SIDE * SIDE) {
        const int column = piece % SIDE, pair = piece / SIDE % SIDE, tile = piece / SIDE / SIDE;
        const int h = tile * BLOCK + column * LANES;
        const int shift = SHIFT(h);
        __global vec *x = spectra + tile_start(block, tile) + 4 * LANES * pair * SIDE + column;
        for (int part = 0; part < 4; ++part) {
            const int first = WRITE_FIRST[part], second = WRITE_SECOND[part];
            SCRATCH const vec *from_first = z + first % 2 * SIDE + pair;
            SCRATCH const vec *from_second = z + second % 2 * SIDE + pair;
            vec a[LANES];
            UNROLL
            for (int i = 0; i < LANES; ++i) {
                const int k = 2 * (place(h, i, shift) / share) * SIDE;
                const int minus_k = 2 * (opposite(h, i, shift) / share) * SIDE;
                a[i] = from_first[first < 2 ? k : minus_k]
                    + WRITE_SIGN[part] * from_second[second < 2 ? k : minus_k];
            }
            transpose(a);
            UNROLL
            for (int l = 0; l < LANES; ++l)
                x[(4 * l + part) * SIDE] = a[l];
        }
    }
    BARRIER;
    FOR_EACH(pair, BLOCK) {
        __global real *x = (__global real *)(spectra + tile_start(block, 0)) + 4 * pair * BLOCK;
        SCRATCH const real *first = (SCRATCH const real *)z + pair;
        SCRATCH const real *second = first + 2 * BLOCK * (1 / share);
        x[0] = 2 * first[0];
        x[2 * BLOCK] = 2 * first[BLOCK];
        x[BLOCK] = 2 * second[0];
        x[3 * BLOCK] = 2 * second[BLOCK];
    }
    BARRIER;
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

/* spectra = 2 sum_x pixels(x) exp(-2 pi i k x / NX), k = 0 .. NX / 2.
 * pixels: one array, const. spectra: n_images arrays, of which array 0 is written, all of it but its
 * padding. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. Out of place. Scratch: NX points. Twin: reference.rfft_rows.
 */
KERNEL void rfft_rows(
    __global vec *restrict spectra, __global const vec *restrict pixels,
    __global const real *restrict steps, const int n_images,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SCRATCH vec *z = OWN_SCRATCH(scratch, NX);
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(pixels, PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        __global const vec *from = pixels + (size_t)block * NX * 2 * SIDE;
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            UNROLL
            for (int q = 0; q < OUTER(NX); ++q)
                a[q] = LOAD(from + lane, q * INNER(NX) + x);
            store_forward(z + lane, a, x, NX, row_roots);
        }
        BARRIER;
        dif_inner(z, NX, row_roots);
        write_tiles(spectra, z, block, 1);
    }
}

/* pixels = sum_k spectra(k) exp(+2 pi i k x / NX) over all k, the half spectra completed.
 * spectra: n_images arrays, const, of which array 0 is read. pixels: one array, all of it is written.
 * steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. Out of place. Scratch: NX points. Twin: reference.irfft_rows.
 */
KERNEL void irfft_rows(
    __global vec *restrict pixels, __global const vec *restrict spectra,
    __global const real *restrict steps, const int n_images,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    SCRATCH vec *z = OWN_SCRATCH(scratch, NX);
    OF_MEMBER(pixels, PIXELS_SIZE);
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        __global vec *to = pixels + (size_t)block * NX * 2 * SIDE;
        read_tiles(z, spectra, block);
        dit_inner(z, NX, row_roots);
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            load_inverse(a, z + lane, x, NX, row_roots);
            UNROLL
            for (int q = 0; q < OUTER(NX); ++q)
                STORE(to + lane, q * INNER(NX) + x, a[q]);
        }
        BARRIER;
    }
}
