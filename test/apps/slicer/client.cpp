// Reads what a server sends with the compiled OpenIGTLink library, and prints a line a message.
// Asks for the list of messages and for tracking data, and ends after so many messages.
//
//     client PORT COUNT

#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "igtlCapabilityMessage.h"
#include "igtlClientSocket.h"
#include "igtlMessageHeader.h"
#include "igtlStatusMessage.h"
#include "igtlStringMessage.h"
#include "igtlTrackingDataMessage.h"
#include "igtlTransformMessage.h"

// The body of a message whose header is there; false where its check sum is not that of its bytes.
template <class Message>
static bool read(igtl::ClientSocket *socket, igtl::MessageHeader *header, Message *message)
{
  message->SetMessageHeader(header);
  message->AllocatePack();
  socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize());
  return (message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY) != 0;
}

static void say(const char *name, igtl::Matrix4x4 m)
{
  printf(" %s", name);
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column) printf(" %.4f", m[row][column]);
}

int main(int, char **arguments)
{
  igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
  if (socket->ConnectToServer("127.0.0.1", atoi(arguments[1])) != 0) return 1;
  igtl::GetCapabilityMessage::Pointer list = igtl::GetCapabilityMessage::New();
  list->Pack();
  socket->Send(list->GetPackPointer(), list->GetPackSize());
  igtl::StartTrackingDataMessage::Pointer begin = igtl::StartTrackingDataMessage::New();
  begin->SetResolution(20);
  begin->Pack();
  socket->Send(begin->GetPackPointer(), begin->GetPackSize());

  for (int left = atoi(arguments[2]); left > 0; --left) {
    igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
    header->InitPack();
    int got = socket->Receive(header->GetPackPointer(), header->GetPackSize());
    if (got != (int)header->GetPackSize()) return 2;
    header->Unpack();
    igtl::TimeStamp::Pointer stamp = igtl::TimeStamp::New();
    header->GetTimeStamp(stamp);
    const char *kind = header->GetDeviceType();
    printf("%s %s %.3f", kind, header->GetDeviceName(), stamp->GetTimeStamp());
    bool good = true;
    if (strcmp(kind, "TRANSFORM") == 0) {
      igtl::TransformMessage::Pointer message = igtl::TransformMessage::New();
      good = read(socket, header, message.GetPointer());
      igtl::Matrix4x4 matrix;
      message->GetMatrix(matrix);
      say("matrix", matrix);
    } else if (strcmp(kind, "STRING") == 0) {
      igtl::StringMessage::Pointer message = igtl::StringMessage::New();
      good = read(socket, header, message.GetPointer());
      printf(" %s", message->GetString());
    } else if (strcmp(kind, "STATUS") == 0) {
      igtl::StatusMessage::Pointer message = igtl::StatusMessage::New();
      good = read(socket, header, message.GetPointer());
      printf(" %d %s %s", message->GetCode(), message->GetErrorName(), message->GetStatusString());
    } else if (strcmp(kind, "CAPABILITY") == 0) {
      igtl::CapabilityMessage::Pointer message = igtl::CapabilityMessage::New();
      good = read(socket, header, message.GetPointer());
      for (int i = 0; i < message->GetNumberOfTypes(); ++i) printf(" %s", message->GetType(i));
    } else if (strcmp(kind, "RTS_TDATA") == 0) {
      igtl::RTSTrackingDataMessage::Pointer message = igtl::RTSTrackingDataMessage::New();
      good = read(socket, header, message.GetPointer());
      printf(" %d", message->GetStatus());
    } else if (strcmp(kind, "TDATA") == 0) {
      igtl::TrackingDataMessage::Pointer message = igtl::TrackingDataMessage::New();
      good = read(socket, header, message.GetPointer());
      for (int i = 0; i < message->GetNumberOfTrackingDataElements(); ++i) {
        igtl::TrackingDataElement::Pointer element;
        message->GetTrackingDataElement(i, element);
        igtl::Matrix4x4 matrix;
        element->GetMatrix(matrix);
        say(element->GetName(), matrix);
      }
    } else {
      socket->Skip(header->GetBodySizeToRead(), 0);
    }
    printf(good ? "\n" : " CHECKSUM\n");
    fflush(stdout);
  }
  socket->CloseSocket();
  return 0;
}
