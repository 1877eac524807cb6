/* A transmission of the sky before the PSF, t_j of image j: a coronagraph, or vignetting. */

/* spectra_j = 2 sum_x t_j(x) f(x) exp(-2 pi i k x / NX): the row spectra of the sky of each image.
 * extended: one array of pixels, f, const. transmission: n_images arrays of pixels, const.
 * spectra: n_images arrays, all of them but their padding is written. steps[GOING] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. Out of place. Scratch: NX points.
 * Twin: reference.transmit_rows.
 */
KERNEL void transmit_rows(
    __global vec *restrict spectra, __global const vec *restrict extended,
    __global const vec *restrict transmission, __global const real *restrict steps,
    const int n_images, __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(extended, PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[GOING], block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        for (int image = 0; image < n_images; ++image) {
            __global const vec *t = transmission + (size_t)image * PIXELS_SIZE + at;
            FOR_EACH(piece, INNER(NX) * SIDE) {
                const int x = piece / SIDE, lane = piece % SIDE;
                cvec a[OUTER(NX)];
                UNROLL
                for (int q = 0; q < OUTER(NX); ++q) {
                    const int pixel = q * INNER(NX);
                    const cvec f = LOAD(FROM_POINT(extended + at, x, lane), pixel);
                    const cvec share = LOAD(FROM_POINT(t, x, lane), pixel);
                    a[q] = (cvec){f.re * share.re, f.im * share.im};
                }
                store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
            }
            BARRIER;
            dif_inner(z, NX, row_roots);
            write_tiles(spectra + (size_t)image * SPECTRA_SIZE, z, block, 1);
        }
    }
}

/* spectra_0 <- row spectrum of sum_j t_j c_j, with c_j that of spectra_j: the adjoint.
 * spectra: n_images arrays, of which array 0 alone is written. transmission: as above.
 * transmitted: one array of pixels, for sums so far. steps[FRESH] 0: nothing.
 * Launch: up to ROW_BLOCKS groups. In place. Scratch: NX points. Twin: reference.gather_rows.
 */
KERNEL void gather_rows(
    __global vec *restrict spectra, __global vec *restrict transmitted,
    __global const vec *restrict transmission, __global const real *restrict steps,
    const int n_images, __global const real *restrict row_roots, SCRATCH vec *restrict scratch)
{
    const real norm = (real)1 / 2 / NX;
    LINES_IN(z, scratch, NX);
    OF_MEMBER(spectra, (size_t)n_images * SPECTRA_SIZE);
    OF_MEMBER(transmitted, PIXELS_SIZE);
    OF_MEMBER(steps, N_NUMBERS);
    FOR_EACH_BLOCK_IF(steps[FRESH], block, ROW_BLOCKS) {
        const size_t at = (size_t)block * NX * 2 * SIDE;
        for (int image = 0; image < n_images; ++image) {
            __global const vec *t = transmission + (size_t)image * PIXELS_SIZE + at;
            read_tiles(z, spectra + (size_t)image * SPECTRA_SIZE, block);
            dit_inner(z, NX, row_roots);
            FOR_EACH(piece, INNER(NX) * SIDE) {
                const int x = piece / SIDE, lane = piece % SIDE;
                cvec a[OUTER(NX)];
                load_inverse(a, OF_LANE(z, lane), x, NX, row_roots);
                UNROLL_IN_GROUPS
                for (int q = 0; q < OUTER(NX); ++q) {
                    const int pixel = q * INNER(NX);
                    __global vec *sum = FROM_POINT(transmitted + at, x, lane);
                    const cvec share = LOAD(FROM_POINT(t, x, lane), pixel);
                    a[q] = (cvec){norm * a[q].re * share.re, norm * a[q].im * share.im};
                    if (image > 0)
                        a[q] = add(a[q], LOAD(sum, pixel));
                    STORE(sum, pixel, a[q]);
                }
                if (image == n_images - 1)
                    store_forward(OF_LANE(z, lane), a, x, NX, row_roots);
            }
            BARRIER;
        }
        dif_inner(z, NX, row_roots);
        write_tiles(spectra, z, block, 1);
    }
}
