/* Half spectra along x, of two rows at a time, to and from the lines of their transforms.
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

/* Where rows 2 BLOCK block + ... of the spectra begin in column block c. */
INLINE size_t tile_start(const int block, const int column_block)
{
    return ((size_t)column_block * ROWS + 2 * BLOCK * block) * 2 * SIDE;
}

#if IN_REGISTERS

/* What an item has of tile t, of those of a block: the columns of one row pair, as many as the pair of
 * its lane, read and written as they lie. From tile to tile there are LINE_ITEMS others.
 */
typedef union {
    PASTE(REAL, 4) quads[BLOCK];
    real parts[4][BLOCK]; /* real and imaginary part of X, and of Y */
} tile;

#define TILES (POINTS(NX) / (2 * BLOCK))
#define OWN_TILE (ITEM / BLOCK)
#define OWN_LANE (ITEM % BLOCK)
#define QUADS(spectra, block, t)                                    \
    ((spectra) + tile_start(block, OWN_TILE) + 4 * OWN_LANE * BLOCK \
        + tile_start(0, (t) * LINE_ITEMS))

/* Where in the exchange column c of tile t and its opposite lie, where one point of Z stands for `share`:
 * at the columns of the item or their complement, and a constant, but for t = 0.
 */
INLINE __local real *at_column(const LINES z, const int t, const int c, const int share)
{
    const int h = OWN_TILE * BLOCK;
    if (t == 0)
        return z->exchange + OWN_LANE + in_exchange(place(h, c, SHIFT(h)) / share);
    const int shift = min(HIGH_BIT(t), RADIX(NX) / (2 * BLOCK));
    return z->exchange + OWN_LANE + in_exchange(h / share)
        + in_exchange(((t + shift) * GROUP + c) / share);
}

INLINE __local real *at_opposite(const LINES z, const int t, const int c, const int share)
{
    const int h = OWN_TILE * BLOCK;
    if (t == 0)
        return z->exchange + OWN_LANE + in_exchange(opposite(h, c, SHIFT(h)) / share);
    const int most = RADIX(NX) / (2 * BLOCK), shift = min(HIGH_BIT(t), most);
    const int opposite_t = ODD(NX) > 1 && shift == most
        ? (POINTS(NX) + RADIX(NX)) / BLOCK - 1 - t - shift
        : (t + shift) ^ (2 * shift - 1);
    return z->exchange + OWN_LANE + in_exchange((GROUP - BLOCK - h) / share)
        + in_exchange((opposite_t * GROUP + BLOCK - 1 - c) / share);
}

#define IS_COLUMN_0(t, c) ((t) == 0 && (c) == 0 && OWN_TILE == 0)

/* Puts one part of Z into the exchange, x_first + sign x_second at the columns and x_first - sign x_second
 * at their opposites; of column 0 x_edge and x_first.
 */
INLINE void put_tiles(
    const LINES z, const tile *x, const int first, const int second, const real sign,
    const int edge)
{
    UNROLL
    for (int t = 0; t < TILES; ++t) {
        UNROLL
        for (int c = 0; c < BLOCK; ++c) {
            const real one = x[t].parts[first][c], other = sign * x[t].parts[second][c];
            const bool edges = IS_COLUMN_0(t, c);
            *at_column(z, t, c, 1) = edges ? x[t].parts[edge][c] : one + other;
            *at_opposite(z, t, c, 1) = edges ? one : one - other;
        }
    }
}

/* Half spectra of one block of row pairs -> Z in the lines, in reversed order. */
INLINE void read_tiles(LINES z, __global const vec *spectra, const int block)
{
    tile x[TILES];
    UNROLL
    for (int t = 0; t < TILES; ++t) {
        UNROLL
        for (int i = 0; i < BLOCK; ++i)
            x[t].quads[i] = ((__global const PASTE(REAL, 4) *)QUADS(spectra, block, t))[i];
    }
    put_tiles(z, x, 0, 3, -1, 1);
    BARRIER;
    take(z, NX, false, LAST(NX), LAST(NX));
    BARRIER;
    put_tiles(z, x, 2, 1, 1, 3);
    BARRIER;
    take(z, NX, true, LAST(NX), LAST(NX));
}

/* Z in the lines, in reversed order -> twice the half spectra of its row pairs; one point of Z stands
 * for `share` points of them.
 */
INLINE void write_tiles(__global vec *spectra, const LINES z, const int block, const int share)
{
    const int n = NX / share;
    tile x[TILES];
    put(z, n, false, LAST(n), LAST(n));
    BARRIER;
    UNROLL
    for (int t = 0; t < TILES; ++t) {
        UNROLL
        for (int c = 0; c < BLOCK; ++c) {
            const real one = *at_column(z, t, c, share), other = *at_opposite(z, t, c, share);
            x[t].parts[0][c] = IS_COLUMN_0(t, c) ? 2 * other : other + one;
            x[t].parts[3][c] = IS_COLUMN_0(t, c) ? 2 * one : other - one;
        }
    }
    BARRIER;
    put(z, n, true, LAST(n), LAST(n));
    BARRIER;
    UNROLL
    for (int t = 0; t < TILES; ++t) {
        UNROLL
        for (int c = 0; c < BLOCK; ++c) {
            const real one = *at_column(z, t, c, share), other = *at_opposite(z, t, c, share);
            const real im = x[t].parts[3][c];
            const bool edges = IS_COLUMN_0(t, c);
            x[t].parts[1][c] = edges ? im : one - other;
            x[t].parts[2][c] = edges ? 2 * other : one + other;
            x[t].parts[3][c] = edges ? 2 * one : im;
        }
        UNROLL
        for (int i = 0; i < BLOCK; ++i)
            ((__global PASTE(REAL, 4) *)QUADS(spectra, block, t))[i] = x[t].quads[i];
    }
    BARRIER;
}

#else

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

#endif
