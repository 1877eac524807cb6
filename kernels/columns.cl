/* Transforms along the columns of half spectra, a block of columns at a time. */

/* Outer and all inner passes of the forward transform of a block of columns of n points. */
INLINE void forward_columns(
    LINES z, __global const vec *from, const int n, __global const real *roots)
{
    FOR_EACH(piece, INNER(n) * SIDE) {
        const int y = piece / SIDE, lane = piece % SIDE;
        cvec a[MAX_OUTER];
        UNROLL
        for (int q = 0; q < OUTER(n); ++q)
            a[q] = LOAD(FROM_POINT(from, y, lane), q * INNER(n));
        store_forward(OF_LANE(z, lane), a, y, n, roots);
    }
    BARRIER;
    dif_inner(z, n, roots);
}

/* The outer pass of the inverse transform of a block of columns of n points. */
INLINE void finish_columns(__global vec *to, const LINES z, const int n, __global const real *roots)
{
    FOR_EACH(piece, INNER(n) * SIDE) {
        const int y = piece / SIDE, lane = piece % SIDE;
        cvec a[MAX_OUTER];
        load_inverse(a, OF_LANE(z, lane), y, n, roots);
        UNROLL
        for (int q = 0; q < OUTER(n); ++q)
            STORE(FROM_POINT(to, y, lane), q * INNER(n), a[q]);
    }
    BARRIER;
}

/* spectra <- sum_y spectra(y) exp(-2 pi i k y / NY), k in reversed order.
 * Launch: up to COLUMN_BLOCKS groups. In place. Scratch: NY points. Twin: reference.fft_columns.
 */
KERNEL void fft_columns(
    __global vec *restrict spectra, __global const real *restrict column_roots,
    SCRATCH vec *restrict scratch)
{
    LINES_IN(z, scratch, NY);
    FOR_EACH_BLOCK(block, COLUMN_BLOCKS) {
        __global vec *columns = spectra + (size_t)block * ROWS * 2 * SIDE;
        forward_columns(z, columns, NY, column_roots);
        FOR_EACH_POINT(i, NY)
            STORE(columns + LANE_OF(i), PLACE_OF(i, NY), POINT(z, i));
        BARRIER;
    }
}

/* spectra <- sum_k spectra(k) exp(+2 pi i k y / NY), k in reversed order.
 * Launch: up to COLUMN_BLOCKS groups. In place. Scratch: NY points. Twin: reference.ifft_columns.
 */
KERNEL void ifft_columns(
    __global vec *restrict spectra, __global const real *restrict column_roots,
    SCRATCH vec *restrict scratch)
{
    LINES_IN(z, scratch, NY);
    FOR_EACH_BLOCK(block, COLUMN_BLOCKS) {
        __global vec *columns = spectra + (size_t)block * ROWS * 2 * SIDE;
        FOR_EACH_POINT(i, NY) {
            const cvec a = LOAD(columns + LANE_OF(i), PLACE_OF(i, NY));
            SET_POINT(z, i, a);
        }
        BARRIER;
        dit_inner(z, NY, column_roots);
        finish_columns(columns, z, NY, column_roots);
    }
}
