/* Counts the calls of MPI's Fortran interface, which MUMPS uses; for coarse.py.
 *
 *     mpicc -shared -fPIC -O1 -o count_calls.so count_calls.c
 *
 * Preload it; call_counts() returns messages sent and collective calls since reset_counts().
 */
#include <mpi.h>

static long messages, bytes, collectives;

void reset_counts(void) { messages = bytes = collectives = 0; }

void call_counts(long *result) {
  result[0] = messages;
  result[1] = bytes;
  result[2] = collectives;
}

static void sent(int *count, MPI_Fint *type) {
  int size;
  MPI_Type_size(MPI_Type_f2c(*type), &size);
  messages++;
  bytes += (long)size * *count;
}

typedef void *P;

#define SEND7(name)                                                           \
  void pmpi_##name##_(P, P, P, P, P, P, P);                                   \
  void mpi_##name##_(P b, P n, P t, P d, P g, P c, P e) {                     \
    sent(n, t);                                                               \
    pmpi_##name##_(b, n, t, d, g, c, e);                                      \
  }
#define SEND8(name)                                                           \
  void pmpi_##name##_(P, P, P, P, P, P, P, P);                                \
  void mpi_##name##_(P b, P n, P t, P d, P g, P c, P r, P e) {                \
    sent(n, t);                                                               \
    pmpi_##name##_(b, n, t, d, g, c, r, e);                                   \
  }
SEND7(send)
SEND7(ssend)
SEND7(bsend)
SEND8(isend)

#define COLLECTIVE(name, parameters, arguments)                               \
  void pmpi_##name##_ parameters;                                             \
  void mpi_##name##_ parameters {                                             \
    collectives++;                                                            \
    pmpi_##name##_ arguments;                                                 \
  }
COLLECTIVE(barrier, (P a, P b), (a, b))
COLLECTIVE(bcast, (P a, P b, P c, P d, P e, P f), (a, b, c, d, e, f))
COLLECTIVE(allreduce, (P a, P b, P c, P d, P e, P f, P g), (a, b, c, d, e, f, g))
COLLECTIVE(reduce, (P a, P b, P c, P d, P e, P f, P g, P h), (a, b, c, d, e, f, g, h))
COLLECTIVE(alltoall, (P a, P b, P c, P d, P e, P f, P g, P h), (a, b, c, d, e, f, g, h))
COLLECTIVE(allgather, (P a, P b, P c, P d, P e, P f, P g, P h), (a, b, c, d, e, f, g, h))
COLLECTIVE(gather, (P a, P b, P c, P d, P e, P f, P g, P h, P i), (a, b, c, d, e, f, g, h, i))
COLLECTIVE(scatter, (P a, P b, P c, P d, P e, P f, P g, P h, P i), (a, b, c, d, e, f, g, h, i))
