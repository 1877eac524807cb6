/* Transforms along the rows, two rows at a time: see tiles.cl. */

/* spectra = 2 sum_x pixels(x) exp(-2 pi i k x / NX), k = 0 .. NX / 2, of each sky.
 * pixels: n_skies arrays, const. spectra: N_SPECTRA arrays, of which the first n_skies are written,
 * all of them but their padding. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups a sky. Out of place. Scratch: NX points. Twin: reference.rfft_rows.
 */
KERNEL void rfft_rows(
    __global vec *restrict spectra, __global const vec *restrict pixels,
    __global const real *restrict steps, const int n_images, const int n_skies,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(pixels, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, ROW_BLOCKS * n_skies) {
        const int block = unit % ROW_BLOCKS;
        __global vec *sky = SPECTRA_OF_SKY(spectra, unit);
        __global const vec *from = pixels + (size_t)unit * NX * 2 * SIDE;
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            UNROLL
            for (int q = 0; q < OUTER(NX); ++q)
                a[q] = LOAD(FROM_POINT(from, x, lane), q * INNER(NX));
            store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
        }
        BARRIER;
        dif_inner(z, NX, row_roots);
        write_tiles(sky, z, block, 1);
    }
}

/* pixels = sum_k spectra(k) exp(+2 pi i k x / NX) over all k, the half spectra completed, of each sky.
 * spectra: N_SPECTRA arrays, const, of which the first n_skies are read. pixels: n_skies arrays, all
 * of them is written. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups a sky. Out of place. Scratch: NX points. Twin: reference.irfft_rows.
 */
KERNEL void irfft_rows(
    __global vec *restrict pixels, __global const vec *restrict spectra,
    __global const real *restrict steps, const int n_images, const int n_skies,
    __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    LINES_IN(z, scratch, NX);
    OF_MEMBER(pixels, (size_t)n_skies * PIXELS_SIZE);
    OF_MEMBER(spectra, N_SPECTRA(n_images, n_skies) * SPECTRA_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], unit, ROW_BLOCKS * n_skies) {
        __global vec *to = pixels + (size_t)unit * NX * 2 * SIDE;
        read_tiles(z, SPECTRA_OF_SKY(spectra, unit), unit % ROW_BLOCKS);
        dit_inner(z, NX, row_roots);
        FOR_EACH(piece, INNER(NX) * SIDE) {
            const int x = piece / SIDE, lane = piece % SIDE;
            cvec a[OUTER(NX)];
            load_inverse(a, OF_LANE(z, lane), x, NX, row_roots);
            UNROLL
            for (int q = 0; q < OUTER(NX); ++q)
                STORE(FROM_POINT(to, x, lane), q * INNER(NX), a[q]);
        }
        BARRIER;
    }
}
