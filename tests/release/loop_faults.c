/* What no vector of the kit holds, on a real controller (thiosulfate_cstr/pid: PVs C_A and T, MV T_j in 0 .. 500 K). */
#define LOOPWRIGHT_NO_MAIN
#include "embedded.h"

#define MUST(what)                                                   \
  do {                                                               \
    if (!(what)) return printf("line %d: " #what "\n", __LINE__), 1; \
  } while (0)

/* Nobody told where the MV stands: nothing may be written until the plant says so. */
static int start(Controller *c) {
  double pv[2] = {0.4, 300}, mv[1] = {200}, beyond[1] = {600};
  Sample good_one = {pv, NULL, mv, 0.0}, no_read_back = {pv, NULL, NULL, 0.0}, outside = {pv, NULL, beyond, 0.0};
  Loop l;
  MUST(loop_open(&l, c, AUTO, 2) && !loop_writes(&l));
  loop_scan(&l, NULL);
  MUST(l.mode == HOLD && !loop_writes(&l));
  loop_scan(&l, &no_read_back);
  MUST(l.mode == HOLD && l.reason[0] && !loop_writes(&l));
  loop_scan(&l, &good_one);
  MUST(loop_writes(&l) && l.mv[0] == 200); /* held: the law waits for two good samples */
  loop_unwritten(&l, "the plant cannot be written");
  MUST(!loop_writes(&l)); /* that first command never arrived */
  loop_scan(&l, &good_one);
  loop_scan(&l, NULL);
  MUST(loop_writes(&l) && l.mv[0] == 200);
  loop_close(&l);
  MUST(loop_open(&l, c, AUTO, 2));
  loop_scan(&l, &good_one);
  MUST(l.mode == AUTO && loop_writes(&l) && l.mv[0] == c->out[OUT_MV][0] && l.mv[0] != 200);
  loop_close(&l);
  MUST(loop_open(&l, c, MANUAL, 2) && loop_set(&l, MV, mv) && !loop_writes(&l));
  loop_scan(&l, &no_read_back);
  MUST(loop_writes(&l) && l.mv[0] == 200); /* the operator's own, once no read-back speaks against it */
  loop_close(&l);
  MUST(loop_open(&l, c, MANUAL, 2) && loop_set(&l, MV, mv));
  loop_scan(&l, &outside);
  loop_scan(&l, &no_read_back);
  MUST(!loop_writes(&l)); /* the plant reads back, and it stands elsewhere */
  loop_close(&l);
  MUST(loop_open(&l, c, AUTO, 2) && !loop_set(&l, MV, mv) && !loop_writes(&l)); /* the law has it */
  loop_close(&l);
  controller_cold(c);
  return 0;
}

static int faults(Loop *l) {
  double pv[2] = {0.4, 300}, mv[1] = {250}, sp[1] = {0.5}, beyond[1] = {1.5}, no_number[1] = {NAN}, before, state;
  Sample good_one = {pv, NULL, mv, 0.0};
  MUST(loop_set(l, SP, sp));
  MUST(!loop_set(l, SP, beyond) && !loop_set(l, SP, no_number) && l->sp[0] == 0.5);
  loop_scan(l, &good_one);
  MUST(l->mode == AUTO && !l->reason[0] && l->c->state[0] != 0);
  mv[0] = before = l->mv[0];
  loop_scan(l, &good_one);
  MUST(l->mv[0] != before);
  loop_unwritten(l, "the plant cannot be written");
  MUST(l->mode == HOLD && l->mv[0] == before && l->c->state[0] == 0 && !strcmp(l->reason, "the plant cannot be written"));
  for (int k = 0; k < 2; k++) {
    loop_scan(l, &good_one);
    MUST(l->mode == HOLD && l->mv[0] == before && l->reason[0]);
  }
  loop_scan(l, &good_one); /* the third good sample, as loop_open was told */
  MUST(l->mode == AUTO && !l->reason[0]);
  state = l->c->state[0];
  loop_gap(l, 3);
  MUST(l->c->state[0] == state);
  loop_gap(l, 4);
  MUST(l->c->state[0] == 0);
  MUST(!loop_set(l, MV, mv) && !strcmp(l->c->words, "the MV is set by hand in MANUAL only; the loop is in AUTO"));
  loop_scan(l, NULL);
  before = l->mv[0];
  MUST(l->mode == HOLD && !loop_set(l, MV, no_number) && !loop_set(l, MV, mv) && l->mv[0] == before);
  loop_set_mode(l, MANUAL);
  MUST(loop_set(l, MV, mv) && l->mv[0] == mv[0]);
  return 0;
}

/* An operator's MV goes on from scan to scan by at most what the MV may move, also while samples are refused. */
static int by_hand(Controller *c) {
  double pv[2] = {0.4, 300}, no_pv[2] = {NAN, 300}, mv[1] = {200}, up[1] = {275}, down[1] = {0};
  Sample good_one = {pv, NULL, mv, 0.0}, refused = {no_pv, NULL, mv, 0.0}, no_read_back = {pv, NULL, NULL, 0.0};
  Loop l;
  ((Signal *)c->signals[MV].at)->max_move = 30;
  MUST(loop_open(&l, c, MANUAL, 2));
  loop_scan(&l, &good_one);
  MUST(loop_set(&l, MV, up) && l.mv[0] == 200);
  loop_scan(&l, &good_one);
  MUST(l.mv[0] == 230);
  loop_unwritten(&l, "the plant cannot be written"); /* no step was made */
  loop_scan(&l, &no_read_back);
  MUST(loop_writes(&l) && l.mv[0] == 230);
  loop_scan(&l, &refused);
  MUST(l.mv[0] == 260);
  loop_scan(&l, NULL);
  loop_scan(&l, &good_one);
  MUST(l.mv[0] == 275 && !l.by_hand);
  MUST(loop_set(&l, MV, down));
  loop_scan(&l, &good_one);
  loop_set_mode(&l, HOLD);
  loop_scan(&l, &good_one);
  loop_set_mode(&l, MANUAL);
  loop_scan(&l, &good_one);
  MUST(l.mv[0] == 245); /* a change of mode ends the way */
  MUST(loop_set(&l, MV, down));
  loop_scan(&l, &good_one);
  loop_unwritten(&l, "the plant cannot be written");
  loop_scan(&l, &good_one);
  loop_scan(&l, &good_one);
  MUST(l.mv[0] == 200); /* where it is found it stays */
  loop_close(&l);
  MUST(loop_open(&l, c, MANUAL, 2) && loop_set(&l, MV, up) && !loop_writes(&l));
  loop_scan(&l, &good_one); /* the plant says where it is */
  MUST(loop_writes(&l) && l.mv[0] == 230);
  loop_close(&l);
  MUST(loop_open(&l, c, MANUAL, 2) && loop_set(&l, MV, up));
  loop_scan(&l, &no_read_back); /* nobody but the operator does */
  MUST(loop_writes(&l) && l.mv[0] == 275);
  loop_close(&l);
  ((Signal *)c->signals[MV].at)->max_move = INFINITY;
  controller_cold(c);
  return 0;
}

/* A command does not arrive and an operator moves the MV meanwhile: nothing is written over it. */
static int moved(Loop *l, Mode mode) {
  double pv[2] = {0.4, 300}, no_pv[2] = {NAN, 300}, mv[1] = {200}, beyond[1] = {600}, no_number[1] = {NAN};
  double wanted[1] = {120};
  Sample good_one = {pv, NULL, mv, 0.0}, other_fault = {no_pv, NULL, mv, 0.0}, no_read_back = {pv, NULL, NULL, 0.0};
  Sample unsound = {pv, NULL, beyond, 0.0}, no_mv = {pv, NULL, no_number, 0.0};
  loop_set_mode(l, mode);
  loop_scan(l, &good_one);
  if (mode == MANUAL) MUST(loop_set(l, MV, wanted));
  loop_unwritten(l, "the plant cannot be written");
  mv[0] = 350;
  MUST(l->mode == (mode == MANUAL ? MANUAL : HOLD) && !loop_writes(l) && !loop_set(l, MV, wanted));
  MUST(strstr(l->c->words, "did not reach the plant"));
  loop_scan(l, NULL);
  MUST(!loop_writes(l));
  loop_scan(l, &unsound);
  MUST(!loop_writes(l) && strstr(l->reason, "no actuator"));
  loop_scan(l, &no_mv);
  MUST(!loop_writes(l));
  loop_scan(l, &good_one);
  MUST(loop_writes(l) && l->mv[0] == 350 && l->mode == (mode == MANUAL ? MANUAL : HOLD));
  loop_unwritten(l, "the plant cannot be written"); /* found, and not forgotten by the next loss */
  MUST(!loop_writes(l) && l->mv[0] == 350);
  mv[0] = 80;
  loop_scan(l, &other_fault); /* refused because of its PV; its read-back tells all the same */
  MUST(loop_writes(l) && l->mv[0] == 80 && l->reason[0]);
  loop_unwritten(l, "the plant cannot be written");
  loop_scan(l, &no_read_back); /* a plant that reads nothing back: the last one that arrived */
  MUST(loop_writes(l) && l->mv[0] == 80);
  loop_unwritten(l, "the plant cannot be written");
  mv[0] = 505; /* beyond the range by less than the margin */
  loop_scan(l, &good_one);
  MUST(loop_writes(l) && l->mv[0] == 500);
  loop_unwritten(l, "the plant cannot be written");
  loop_scan(l, &unsound); /* the plant reads back, so the old MV is nothing to go back to */
  loop_scan(l, &no_read_back);
  MUST(!loop_writes(l) && strstr(l->reason, "there is no read-back"));
  loop_scan(l, &good_one);
  MUST(loop_writes(l) && l->mv[0] == 500);
  return 0;
}

/* A vector that is missing is refused, where the graph uses it. */
static int missing(Loop *l) {
  Controller *c = l->c;
  double pv[2] = {0.4, 300}, mv[1] = {200};
  Sample no_pv = {NULL, NULL, mv, 0.0}, no_dv = {pv, NULL, mv, 0.0};
  loop_set_mode(l, AUTO);
  loop_scan(l, &no_pv);
  MUST(l->mode == HOLD && !strcmp(l->reason, "the sample has no pv"));
  const double *const given[STATE] = {[SP] = l->sp, [PV] = NULL, [DV] = NULL, [MV] = mv};
  MUST(controller_step(c, given) == REFUSED_INPUT && !strcmp(c->words, "pv is missing; no MV is computed without it"));
  /* This law uses no measured disturbance. One that did would refuse a sample without it. */
  Signal flow = {.name = "flow", .unit = "l/s", .low = 0, .high = 1};
  Signals none = c->signals[DV];
  c->signals[DV] = (Signals){&flow, 1};
  c->n_in[DV] = 1;
  c->uses[DV] = true;
  loop_scan(l, &no_dv);
  MUST(l->mode == HOLD && !strcmp(l->reason, "the sample has no dv"));
  c->uses[DV] = false;
  c->n_in[DV] = 0;
  c->signals[DV] = none;
  return 0;
}

int main(int n, char **words) {
  Controller c;
  Loop l = {0};
  bool open = n == 2 && controller_open(&c, words[1]) && loop_open(&l, &c, AUTO, 3);
  int status = !open ? 2 : start(&c) || by_hand(&c) || faults(&l) || moved(&l, AUTO) || moved(&l, MANUAL) || missing(&l);
  loop_close(&l);
  controller_close(&c);
  if (!status) puts("all as it must be");
  return status;
}
